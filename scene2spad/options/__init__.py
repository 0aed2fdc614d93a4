"""Options of commands and studies as dataclasses. No torch, no Mitsuba: --help is quick."""
