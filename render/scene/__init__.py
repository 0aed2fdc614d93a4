"""Hold a `Scene` as the ray tracer sees it: Mitsuba scene, camera, laser, rays."""
