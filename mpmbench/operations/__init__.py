"""What primitives compute: inputs, reference and least traffic of each operation, shared by all its strategies."""
