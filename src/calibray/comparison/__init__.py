"""Methods compared at equal budgets, and the paper's experiment."""
