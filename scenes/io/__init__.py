"""Read meshes, Mitsuba files, RGB-D pairs and textures as scenes; check files before they are believed."""
