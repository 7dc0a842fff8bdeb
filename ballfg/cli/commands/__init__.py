"""The commands of `ballfg`, one file each: they parse, call and print."""
