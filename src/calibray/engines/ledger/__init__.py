"""The ledger: a file that keeps every RT call that was paid for."""
