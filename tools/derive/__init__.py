"""Deriving the tensors of transformers' model classes by finite differences. See README.md here."""
