//! What must hold of the readers' answers whatever bytes they get.
//!
//! The mutation test and the fuzz targets state the same laws about different inputs. A law that is broken panics.

#![allow(dead_code, reason = "each user needs some of the laws")]
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

use ckpt_doctor::checkpoint::{Fault, FaultKind, FaultSource};

/// Faults are of a reader's kinds, about the file that was read, and their spans lie inside its text.
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

/// Whether a fault of this kind is among them.
pub fn has(faults: &[Fault], kind: FaultKind) -> bool {
    faults.iter().any(|f| f.kind == kind)
}
