"""The ledger: every RT call that was ever paid for."""
