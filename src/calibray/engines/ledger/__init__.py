"""The ledger: a file that stores every completed RT call."""
