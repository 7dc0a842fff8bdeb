"""Tests for patterns that remain after the search, and describes them without a cause."""
