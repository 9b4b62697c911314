"""Light transport: one file a backend."""
