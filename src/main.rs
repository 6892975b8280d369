//! The `ckpt-doctor` program.

use std::process::ExitCode;

fn main() -> ExitCode {
    ckpt_doctor::main()
}
