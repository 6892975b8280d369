//! The `ckpt-doctor` program.

fn main() {}
