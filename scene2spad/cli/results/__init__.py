"""Commands that read what other commands wrote: look inside, compare, convert, show."""
