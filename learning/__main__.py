"""`python -m ballfg.learning` is `ballfg-train`, so that torchrun can start it as a module."""

from ballfg.learning.cli import run

if __name__ == "__main__":
    run()
