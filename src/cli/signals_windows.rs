//! In place of `signals.rs` on Windows: only writers stop on a signal, and none runs there.

use super::exit::FAILED;

pub const fn fail_at_file_size_limit() {}

pub const fn install() -> anyhow::Result<()> {
    Ok(())
}

pub const fn exit_code() -> u8 {
    FAILED
}
