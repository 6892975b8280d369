//! The `ckpt-doctor` program.

use std::process::ExitCode;

/// The allocator of musl is slow for the many short strings of headers. This one also grows large buffers without copying
/// them, and reserves no address space.
#[cfg(target_env = "musl")]
#[global_allocator]
static ALLOCATOR: dlmalloc::GlobalDlmalloc = dlmalloc::GlobalDlmalloc;

fn main() -> ExitCode {
    ckpt_doctor::main()
}
