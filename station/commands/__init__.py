"""Commands, one group per file: arguments, help texts, output. Their work is imported when they run."""
