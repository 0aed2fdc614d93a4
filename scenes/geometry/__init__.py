"""Make and move triangle meshes."""
