//! Verifies a merged checkpoint: against the digests of its manifest, and byte for byte against its donors.

mod recorded;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use self::recorded::{Recorded, RecordedFile, RecordedTensor};
use super::manifest;
use super::run::count;
use crate::checkpoint::contents::digests::Digester;
use crate::checkpoint::open::OpenError;
use crate::checkpoint::platform::shown;
use crate::checkpoint::{Checkpoint, Dtype, EntryKind, Shard, Tensor};
use crate::knowledge::source::hint;
use crate::report::verification::{DifferenceKind, Verification, VerifiedPart};
use crate::surgery::ApplyError;
use crate::surgery::compare::compare;
use crate::surgery::plan::{PlannedTensor, TensorRef, TensorSource, TensorTransform};

/// Why a result could not be verified.
#[derive(Debug, thiserror::Error)]
pub enum VerifyError {
    /// The manifest is missing or cannot be used.
    #[error("{}: {reason}", path.display())]
    Manifest {
        /// The manifest.
        path: PathBuf,
        /// The cause and the next step.
        reason: String,
    },
    /// A role that the manifest does not have.
    #[error("the manifest has no donor {role}; {hint}")]
    Role {
        /// The given role.
        role: String,
        /// The roles of the manifest.
        hint: String,
    },
    /// The result or a donor cannot be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// A file could not be read to its end.
    #[error(transparent)]
    Read(#[from] ApplyError),
}

/// Verifies the result in `dir`; `donors` are directories by role, whose tensors are recomputed and compared.
///
/// # Errors
/// A [`VerifyError`]; differences are not errors.
pub fn verify(dir: &Path, donors: &BTreeMap<String, PathBuf>) -> Result<Verification, VerifyError> {
    let result = Checkpoint::open(dir)?;
    let recorded = Recorded::read(dir)?;
    if let Some(role) = donors.keys().find(|role| !recorded.donors.contains_key(*role)) {
        let known: Vec<&str> = recorded.donors.keys().map(String::as_str).collect();
        return Err(VerifyError::Role { role: role.clone(), hint: hint(role, &known) });
    }
    let mut run = Run::new(&result, &recorded);
    let mut parts = Vec::new();
    if recorded.schema >= 2 {
        parts.push(run.files()?);
    }
    parts.push(run.tensors());
    for (role, dir) in donors {
        let donor = Checkpoint::open(dir)?;
        parts.push(run.donor_files(role, &donor)?);
        parts.push(run.recomputed(role, &donor)?);
    }
    Ok(Verification::new(shown(dir), recorded.recipe(), recorded.schema, parts, run.unverified))
}

struct Run<'v> {
    result: &'v Checkpoint,
    recorded: &'v Recorded,
    /// The tensors of the result by shard and name.
    present: BTreeMap<(&'v str, &'v str), (&'v Shard, &'v Tensor)>,
    /// SHA-256 of tensors of the result by shard and name.
    digests: BTreeMap<(&'v str, &'v str), String>,
    digester: Digester,
    /// What could not be verified, one sentence each.
    unverified: Vec<String>,
}

impl<'v> Run<'v> {
    fn new(result: &'v Checkpoint, recorded: &'v Recorded) -> Self {
        let tensors = result.tensors();
        let present = tensors.map(|(s, t)| ((s.name.as_str(), t.name.as_str()), (s, t))).collect();
        let mut unverified = Vec::new();
        if recorded.schema < 2 {
            unverified.push("a manifest of version 1 has no digests of the files and tensors of the result".to_owned());
        }
        if result.is_partial() {
            unverified.push("the checkpoint is too large to be read whole".to_owned());
        }
        Self { result, recorded, present, digests: BTreeMap::new(), digester: Digester::new(), unverified }
    }

    /// The files of the result against the digests of the manifest.
    fn files(&mut self) -> Result<VerifiedPart, VerifyError> {
        let mut part = VerifiedPart::new("files");
        let (result, recorded) = (self.result, self.recorded);
        for (name, file) in &recorded.files {
            let shard = result.shards.get(name);
            self.file(&result.root, name, file, shard, &mut part)?;
        }
        for (name, entry) in &result.entries {
            let is_known = recorded.files.contains_key(name) || **name == *manifest::NAME;
            // Hidden files belong to other tools, such as git.
            if !is_known && !name.starts_with('.') {
                let detail = (entry.kind != EntryKind::Regular).then(|| format!("a {}", entry.kind));
                part.differ(name, DifferenceKind::Extra, detail);
            }
        }
        Ok(part)
    }

    /// One file against its digest; the digests of its tensors are kept if it is a shard of the result.
    fn file(
        &mut self,
        root: &Path,
        name: &str,
        recorded: &RecordedFile,
        shard: Option<&'v Shard>,
        part: &mut VerifiedPart,
    ) -> Result<(), VerifyError> {
        let mut tensors: Vec<&Tensor> = shard.iter().flat_map(|s| &s.tensors).filter(|t| t.begin <= t.end).collect();
        tensors.sort_by_key(|tensor| (tensor.begin, tensor.end));
        let start = shard.map_or(0, |shard| shard.data_start);
        let ranges: Vec<(u64, u64)> = tensors.iter().map(|t| (start.saturating_add(t.begin), t.len())).collect();
        let found = match self.digester.file(root, name, &ranges) {
            Ok(found) => found,
            Err(OpenError::NotFound { .. }) => {
                part.differ(name, DifferenceKind::Missing, None);
                return Ok(());
            }
            Err(error @ OpenError::Io { .. }) => return Err(error.into()),
            Err(error) => {
                part.differ(name, DifferenceKind::Differs, Some(error.to_string()));
                return Ok(());
            }
        };
        for (tensor, digest) in tensors.into_iter().zip(found.ranges) {
            let key = shard.map_or("", |shard| shard.name.as_str());
            self.digests.extend(digest.map(|digest| ((key, tensor.name.as_str()), digest)));
        }
        match (recorded.bytes, found.sha256) {
            (Some(bytes), _) if bytes != found.bytes => {
                let detail = format!("has {} bytes, {bytes} are recorded", found.bytes);
                part.differ(name, DifferenceKind::Differs, Some(detail));
            }
            (_, Some(digest)) if digest == recorded.sha256 => part.equal = part.equal.saturating_add(1),
            (_, Some(_)) => part.differ(name, DifferenceKind::Differs, Some("has another SHA-256".to_owned())),
            (_, None) => self.unverified.push(format!("{name} has holes, with more zeros than are hashed")),
        }
        Ok(())
    }

    /// The tensors of the result against the manifest.
    fn tensors(&mut self) -> VerifiedPart {
        let mut part = VerifiedPart::new("tensors");
        let mut unhashed = 0_usize;
        for tensor in &self.recorded.tensors {
            let key = (tensor.shard.as_str(), tensor.name.as_str());
            let Some((_, found)) = self.present.get(&key) else {
                let detail = format!("not in {}", tensor.shard);
                part.differ(&tensor.name, DifferenceKind::Missing, Some(detail));
                continue;
            };
            if let Some(detail) = header_difference(found, tensor) {
                part.differ(&tensor.name, DifferenceKind::Differs, Some(detail));
                continue;
            }
            match (&tensor.sha256, self.digests.get(&key)) {
                (Some(recorded), Some(found)) if recorded == found => part.equal = part.equal.saturating_add(1),
                (Some(_), Some(_)) => {
                    let detail = Some(format!("has another SHA-256 in {}", tensor.shard));
                    part.differ(&tensor.name, DifferenceKind::Differs, detail);
                }
                _ => unhashed = unhashed.saturating_add(1),
            }
        }
        if unhashed > 0 {
            let tensors = count(unhashed, "tensor was", "tensors were");
            self.unverified.push(format!("{tensors} compared by shape and dtype alone"));
        }
        let recorded: BTreeSet<(&str, &str)> =
            self.recorded.tensors.iter().map(|t| (t.shard.as_str(), t.name.as_str())).collect();
        for (shard, name) in self.present.keys().filter(|key| !recorded.contains(*key)) {
            part.differ(name, DifferenceKind::Extra, Some(format!("in {shard}")));
        }
        part
    }

    /// The files of a donor against the manifest.
    fn donor_files(&mut self, role: &str, donor: &Checkpoint) -> Result<VerifiedPart, VerifyError> {
        let mut part = VerifiedPart::new(&format!("files of donor {role}"));
        let Some(recorded) = self.recorded.donors.get(role) else { return Ok(part) };
        for (name, file) in &recorded.files {
            self.file(&donor.root, name, file, None, &mut part)?;
        }
        for (name, shard) in &recorded.shards {
            match (donor.shards.get(name), &shard.sha256) {
                (None, _) => part.differ(name, DifferenceKind::Missing, None),
                (Some(found), _) if found.file_len != shard.bytes || found.header_sha256 != shard.header_sha256 => {
                    part.differ(name, DifferenceKind::Differs, Some("has another size or header".to_owned()));
                }
                (Some(_), None) => part.equal = part.equal.saturating_add(1),
                (Some(_), Some(sha256)) => {
                    let file = RecordedFile { bytes: Some(shard.bytes), sha256: sha256.clone() };
                    self.file(&donor.root, name, &file, None, &mut part)?;
                }
            }
        }
        Ok(part)
    }

    /// The tensors of the result that were made from a donor, recomputed and compared byte for byte.
    fn recomputed(&mut self, role: &str, donor: &Checkpoint) -> Result<VerifiedPart, VerifyError> {
        let mut part = VerifiedPart::new(&format!("tensors recomputed from donor {role}"));
        let there: BTreeMap<&str, (&Shard, &Tensor)> =
            donor.tensors().map(|(s, t)| (t.name.as_str(), (s, t))).collect();
        for tensor in self.recorded.tensors.iter().filter(|tensor| tensor.source.donor == role) {
            let present = self.present.get(&(tensor.shard.as_str(), tensor.name.as_str()));
            // Reported with the tensors of the result.
            let Some((shard, found)) = present.filter(|(_, t)| header_difference(t, tensor).is_none()) else {
                continue;
            };
            let from = there.get(tensor.source.name.as_str());
            let planned = from.and_then(|(shard, from)| planned(tensor, found, role, &donor.root, shard, from));
            let Some(planned) = planned.filter(|planned| shard.is_whole() && planned.is_possible()) else {
                let detail = format!("the donor has no {} that it could be made from", tensor.source.name);
                part.differ(&tensor.name, DifferenceKind::Missing, Some(detail));
                continue;
            };
            let at = shard.data_start.saturating_add(found.begin);
            let compared = compare(&planned, &self.result.root.join(&shard.name), at)?;
            // The digest of a copy is that of its source.
            let copied = tensor.sha256.as_ref().filter(|_| tensor.transform == TensorTransform::Copy);
            let source = tensor.source.sha256.as_ref().or(copied);
            let is_other_donor =
                source.is_some_and(|s| compared.source_sha256.as_ref().is_some_and(|found| s != found));
            match compared.difference {
                None => part.equal = part.equal.saturating_add(1),
                Some(place) => {
                    let cause = if is_other_donor { "; the donor's tensor is not the recorded one" } else { "" };
                    let detail = format!("from byte {place} of {} on{cause}", planned.len());
                    part.differ(&tensor.name, DifferenceKind::Differs, Some(detail));
                }
            }
        }
        Ok(part)
    }
}

/// How the header entry of a tensor differs from the recorded one; `None` if it does not.
fn header_difference(found: &Tensor, recorded: &RecordedTensor) -> Option<String> {
    let differs = found.dtype.name() != recorded.dtype || found.shape != recorded.shape;
    differs.then(|| {
        let (is, was) = ((found.dtype, &found.shape), (&recorded.dtype, &recorded.shape));
        format!("is {} {:?}, recorded is {} {:?}", is.0, is.1, was.0, was.1)
    })
}

/// The plan of a recorded tensor; `None` when the donor's tensor has another type or shape than the recorded one.
fn planned(
    recorded: &RecordedTensor,
    result: &Tensor,
    role: &str,
    root: &Path,
    shard: &Shard,
    tensor: &Tensor,
) -> Option<PlannedTensor> {
    let source = &recorded.source;
    // Version 1 knew no casts.
    let dtype = source.dtype.as_deref().map_or(Some(result.dtype), Dtype::from_name)?;
    let rows = source.slice.and_then(|slice| Some([slice.first, *source.shape.first()?]));
    let from = TensorRef::new(role, root, shard, tensor, rows).ok()?;
    if from.dtype != dtype || from.shape != source.shape || !shard.is_whole() {
        return None;
    }
    let fit = match recorded.transform {
        TensorTransform::Convert => TensorTransform::Copy,
        fit => fit,
    };
    Some(PlannedTensor {
        name: recorded.name.clone(),
        dtype: result.dtype,
        shape: result.shape.clone(),
        source: TensorSource { from, fit, scale: recorded.scale },
    })
}
