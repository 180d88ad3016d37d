"""Methods that learn an expensive model from few calls: space mapping and vector surrogates."""
