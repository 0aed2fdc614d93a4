"""Render scene sets, in processes or on a cluster; planes, captures."""
