"""Signal processing that is independent of the string model: powers of damped exponentials on an even grid."""
