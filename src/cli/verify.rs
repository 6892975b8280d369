//! `verify`.

use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::bail;

use super::args::{VerifyArgs, VerifyFormat};
use super::exit::{CLEAN, FAILED, FINDINGS};
use super::output;
use crate::merge;
use crate::report::verification::{self, VerificationVerdict};

/// Runs `verify`.
pub fn run(args: &VerifyArgs) -> anyhow::Result<u8> {
    let mut donors = BTreeMap::new();
    for (role, dir) in &args.donor {
        if donors.insert(role.clone(), PathBuf::from(dir)).is_some() {
            bail!("donor {role} is given more than once");
        }
    }
    let verification = merge::verify(&args.path, &donors)?;
    output::print(&match args.output_format {
        VerifyFormat::Full => verification::full(&verification, output::style(args.color)),
        VerifyFormat::Json => verification::json(&verification),
    })?;
    Ok(match verification.verdict {
        VerificationVerdict::Equal => CLEAN,
        VerificationVerdict::Differs => FINDINGS,
        VerificationVerdict::Incomplete => FAILED,
    })
}
