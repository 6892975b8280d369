//! The program from the outside: arguments, output and exit codes.

#[cfg(unix)]
mod adapters;
#[cfg(unix)]
mod check;
#[cfg(unix)]
mod diff;
mod expect;
#[cfg(unix)]
mod inspect;
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
