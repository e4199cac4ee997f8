"""Votes of masks about landmarks, class beliefs, probability of moving."""
