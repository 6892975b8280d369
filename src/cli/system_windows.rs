//! What the command line asks the system, on Windows.

/// Width of the terminal at standard output, in columns; `None` when it does not tell.
pub fn columns() -> Option<usize> {
    let (terminal_size::Width(width), _) = terminal_size::terminal_size_of(std::io::stdout())?;
    Some(usize::from(width))
}

/// Whether the terminal at standard output shows colours: Windows 10 and later do when they are asked to.
pub fn shows_color() -> bool {
    anstyle_query::windows::enable_ansi_colors() == Some(true)
}

/// Bytes of the stack of the main thread: what linkers reserve.
pub const fn stack() -> Option<u64> {
    Some(1 << 20)
}
