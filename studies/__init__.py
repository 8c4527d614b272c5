"""Studies that are run from a clone. The installed package does not contain them."""
