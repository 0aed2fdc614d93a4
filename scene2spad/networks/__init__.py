"""Train and evaluate by the command line's words; find trained models, or train the missing ones; test sets."""
