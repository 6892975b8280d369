//! Architectures, predicted loads and config values, against records of the real loaders.

mod architectures;
mod recorded_all;
mod recorded_sample;
mod remote_code;
mod votes;
