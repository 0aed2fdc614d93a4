"""Scene -> Transient. `render.transient` imports no renderer; `render.engine` is where Mitsuba comes in."""
