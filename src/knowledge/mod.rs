//! What should be: rules, architectures and recipes read from `rules/`, and their expressions.
