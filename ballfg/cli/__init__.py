"""The command `ballfg`: one file a sub-command; they parse, call and print."""
