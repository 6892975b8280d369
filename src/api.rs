//! The public interface of the library: the stages, run for a caller with the data files inside the crate.

mod checker;
mod error;
mod merge;
mod shard;

use std::sync::OnceLock;

pub use checker::Checker;
pub use error::Error;
pub use merge::Merge;

use crate::knowledge::Knowledge;
use crate::knowledge::loader;

/// A version of transformers, as the builders take it.
fn version(text: &str) -> Result<String, Error> {
    loader::parse_requirement(&format!("transformers=={text}")).map_err(|_| Error::Version(text.to_owned()))
}

/// The data files inside the crate, parsed at the first call.
fn knowledge() -> Result<&'static Knowledge, Error> {
    static KNOWLEDGE: OnceLock<Knowledge> = OnceLock::new();
    if let Some(knowledge) = KNOWLEDGE.get() {
        return Ok(knowledge);
    }
    let knowledge = Knowledge::embedded()?;
    Ok(KNOWLEDGE.get_or_init(|| knowledge))
}
