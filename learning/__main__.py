"""`python -m ballfg.learning` is `ballfg-train`, so that torchrun can start it as a module."""

from ballfg.cli.entry import train

if __name__ == "__main__":
    train()
