//! Rebuilds the program when a file in `rules/` changes: the program embeds this directory.

#![allow(clippy::print_stdout, reason = "how a build script talks to cargo")]

fn main() {
    println!("cargo::rerun-if-changed=rules");
}
