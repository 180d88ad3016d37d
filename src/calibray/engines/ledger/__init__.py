"""The ledger: a file that stores every RT call that was paid for."""
