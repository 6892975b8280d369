//! One report, many renderers. Nothing here loads, checks or writes a checkpoint.

pub mod model;
