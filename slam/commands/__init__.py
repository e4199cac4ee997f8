"""Sub-commands of the command line, each with its parser and its handler in a module of its own."""
