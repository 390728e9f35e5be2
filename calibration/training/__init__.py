"""`train`: labelled captures become a model, with a card that says how good it is and where it holds."""
