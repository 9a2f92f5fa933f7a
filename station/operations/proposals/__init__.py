"""Site files that `station init --from` proposes for what lies in a folder."""
