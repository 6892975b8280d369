//! The program from the outside: arguments, output and exit codes.

#[cfg(unix)]
mod check;
mod expect;
#[cfg(unix)]
mod pins;
#[cfg(unix)]
mod selection;
#[cfg(target_os = "linux")]
mod templates;
#[cfg(unix)]
mod usage;
#[cfg(unix)]
mod workers;
