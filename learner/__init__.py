"""Who learns and shows: asks an algorithm, keeps the books, records."""
