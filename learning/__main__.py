"""Runs `ballfg-train` as `python -m ballfg.learning`, so that torchrun can start it as a module."""

from ballfg.cli.entry import train

if __name__ == "__main__":
    train()
