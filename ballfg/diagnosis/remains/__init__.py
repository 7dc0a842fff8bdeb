"""Tests for patterns that remain after the search, and descriptions of them without a cause."""
