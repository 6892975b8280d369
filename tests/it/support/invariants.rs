//! Invariants of the readers for arbitrary bytes.
//!
//! The mutation test and the fuzz targets check the same invariants on different inputs. A violation panics.

#![allow(dead_code, reason = "each user needs some of the invariants")]
#![allow(
    clippy::arithmetic_side_effects,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a panic is the finding"
)]

#[path = "invariants/documents.rs"]
pub mod documents;
#[path = "invariants/header.rs"]
pub mod header;
#[path = "invariants/module.rs"]
pub mod module;
#[path = "invariants/pickle.rs"]
pub mod pickle;

use ckpt_doctor::checkpoint::{Fault, FaultKind, FaultSource};

/// Faults have a reader's kind and name the file, and their spans lie inside its text.
pub fn faults_are_placed(faults: &[Fault], file: &str, text: Option<&str>) {
    for fault in faults {
        assert_eq!(fault.kind.source(), FaultSource::Reader, "{fault:?}");
        for place in &fault.places {
            assert_eq!(place.file.as_deref(), Some(file), "{fault:?}");
            if let Some(span) = &place.span {
                let text = text.expect("a span needs a text");
                assert!(text.get(span.clone()).is_some(), "{fault:?} points outside of the text, or into a character");
            }
        }
    }
}

/// Whether the faults contain this kind.
pub fn has(faults: &[Fault], kind: FaultKind) -> bool {
    faults.iter().any(|f| f.kind == kind)
}
