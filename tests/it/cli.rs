//! The program from the outside: arguments, output and exit codes.

#[cfg(unix)]
mod check;
mod expect;
#[cfg(unix)]
mod selection;
#[cfg(unix)]
mod usage;
