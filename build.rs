//! The program carries `rules/` inside: build it again when a file there changes or comes along.

#![allow(clippy::print_stdout, reason = "how a build script talks to cargo")]

fn main() {
    println!("cargo::rerun-if-changed=rules");
}
