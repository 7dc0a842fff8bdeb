"""The command `ballfg` has one file per sub-command, which parses, calls and prints."""
