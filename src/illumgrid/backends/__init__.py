"""Light transport: one file per backend."""
