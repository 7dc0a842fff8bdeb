"""Each command of `ballfg` has a file, which parses, calls and prints."""
