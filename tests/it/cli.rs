//! The program from the outside: arguments, output and exit codes.

mod check;
mod expect;
mod selection;
mod usage;
