//! Verifies a merged checkpoint: against the digests of its manifest, and byte for byte against its donors.

mod recorded;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use self::recorded::{Recorded, RecordedFile, RecordedShard, RecordedTensor};
use super::donor_tensor::DonorTensor;
use super::manifest;
use super::named::Bounds;
use super::run::count;
use crate::checkpoint::contents::digests::{HashJob, hash};
use crate::checkpoint::platform::shown;
use crate::checkpoint::{Checkpoint, Dtype, EntryKind, HashAlgorithm, OpenError, Shard, Source, Tensor, parallel};
use crate::knowledge::source::hint;
use crate::report::verification::{DifferenceKind, Verification, VerifiedPart};
use crate::surgery::ApplyError;
use crate::surgery::compare::compare;
use crate::surgery::expr::TensorExpr;
use crate::surgery::planned_tensor::PlannedTensor;
use crate::surgery::tensor_ref::TensorRef;

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
    let bounds = recorded.bounds().transpose().map_err(|reason| VerifyError::Manifest {
        path: dir.join(&*manifest::NAME),
        reason: format!("{reason}; the manifest is damaged"),
    })?;
    let bounds = bounds.map(|bounds| bounds.paid_by(recorded.bytes_of_names()));
    let mut run = Run::new(&result, &recorded, bounds);
    let mut parts = Vec::new();
    if recorded.schema >= 2 {
        parts.push(run.files()?);
    }
    parts.push(run.tensors()?);
    let opened = donors.iter().map(|(role, dir)| Ok((role.as_str(), Checkpoint::open(dir)?)));
    let opened: BTreeMap<&str, Checkpoint> = opened.collect::<Result<_, OpenError>>()?;
    let given = Given::new(&opened);
    for (role, donor) in &opened {
        parts.push(run.donor_files(role, donor)?);
        parts.push(run.recomputed(role, &given)?);
    }
    if run.bounds.as_ref().is_some_and(Bounds::is_exceeded) {
        run.unverified
            .push("\"changes\" of the manifest take too long to compare with the names of its tensors".to_owned());
    }
    Ok(Verification::new(shown(dir), recorded.recipe(), recorded.schema, parts, run.unverified))
}

/// Hidden entries that tools put beside a result: git, huggingface_hub, this program and the Finder of macOS. No loader reads one.
const OF_TOOLS: [&str; 6] = [".cache", ".ckpt-doctor", ".DS_Store", ".git", ".gitattributes", ".gitignore"];

struct Run<'v> {
    result: &'v Checkpoint,
    recorded: &'v Recorded,
    /// What the merge was allowed to change; `None` for a manifest that does not say it.
    bounds: Option<Bounds<'v>>,
    /// The tensors of the result by shard and name.
    present: BTreeMap<(&'v str, &'v str), (&'v Shard, &'v Tensor)>,
    /// What could not be verified, one sentence each.
    unverified: Vec<String>,
}

impl<'v> Run<'v> {
    fn new(result: &'v Checkpoint, recorded: &'v Recorded, bounds: Option<Bounds<'v>>) -> Self {
        let tensors = result.tensors();
        let present = tensors.map(|(s, t)| ((s.name.as_str(), t.name.as_str()), (s, t))).collect();
        let mut unverified = Vec::new();
        if recorded.schema < 2 {
            unverified.push("a manifest of version 1 has no digests of the files and tensors of the result".to_owned());
        } else if recorded.hash() == HashAlgorithm::None {
            unverified.push("the manifest has no digests of tensors: the merge ran with --hash none".to_owned());
        }
        if bounds.is_none() {
            unverified.extend(without_bounds(recorded));
        }
        if result.is_partial() {
            unverified.push("the checkpoint is too large to be read whole".to_owned());
        }
        Self { result, recorded, bounds, present, unverified }
    }

    /// The files of the result against the digests of the manifest, and its shards against those of their headers.
    fn files(&mut self) -> Result<VerifiedPart, VerifyError> {
        let mut part = VerifiedPart::new("files");
        let (result, recorded) = (self.result, self.recorded);
        self.compare_files(&result.source, &recorded.files, &mut part)?;
        let own = |name: &str| result.source.open_own(name, u64::MAX).map(drop);
        compare_headers(result, &recorded.shards, own, &mut part);
        for (name, entry) in &result.entries {
            let is_recorded = recorded.files.contains_key(name) || recorded.shards.contains_key(name);
            if !is_recorded && **name != *manifest::NAME {
                let detail = (entry.kind != EntryKind::Regular).then(|| format!("a {}", entry.kind));
                part.differ(name, DifferenceKind::Extra, detail);
            }
        }
        for name in hidden(&result.source)? {
            if !recorded.files.contains_key(&name) {
                part.differ(&name, DifferenceKind::Extra, Some("hidden".to_owned()));
            }
        }
        Ok(part)
    }

    /// Files of one checkpoint against their digests.
    fn compare_files(
        &mut self,
        source: &Source,
        files: &BTreeMap<String, RecordedFile>,
        part: &mut VerifiedPart,
    ) -> Result<(), VerifyError> {
        let jobs: Vec<HashJob<'_>> =
            files.keys().map(|name| HashJob { source, name, range: None, algorithm: HashAlgorithm::Sha256 }).collect();
        for ((name, recorded), found) in files.iter().zip(hash(&jobs)) {
            let found = match found {
                Ok(found) => found,
                Err(OpenError::NotFound { .. }) => {
                    part.differ(name, DifferenceKind::Missing, None);
                    continue;
                }
                Err(error @ OpenError::Io { .. }) => return Err(error.into()),
                Err(error) => {
                    part.differ(name, DifferenceKind::Differs, Some(error.to_string()));
                    continue;
                }
            };
            match (recorded.bytes, found.digest) {
                (Some(bytes), _) if bytes != found.file_len => {
                    let detail = format!("has {} bytes, {bytes} are recorded", found.file_len);
                    part.differ(name, DifferenceKind::Differs, Some(detail));
                }
                (_, Some(digest)) if digest == recorded.sha256 => part.equal = part.equal.saturating_add(1),
                (_, Some(_)) => part.differ(name, DifferenceKind::Differs, Some("has another SHA-256".to_owned())),
                (_, None) => self.unverified.push(format!("{name} has holes, with more zeros than are hashed")),
            }
        }
        Ok(())
    }

    /// The tensors of the result against the manifest.
    fn tensors(&mut self) -> Result<VerifiedPart, VerifyError> {
        let mut part = VerifiedPart::new("tensors");
        let mut unhashed = 0_usize;
        let digests = self.digests()?;
        for tensor in &self.recorded.tensors {
            let key = (tensor.shard.as_str(), tensor.name.as_str());
            let Some((_, found)) = self.present.get(&key) else {
                let detail = format!("not in {}", tensor.shard);
                part.differ(&tensor.name, DifferenceKind::Missing, Some(detail));
                continue;
            };
            if let Some(detail) = header_difference(found, tensor).or_else(|| self.stray(tensor)) {
                part.differ(&tensor.name, DifferenceKind::Differs, Some(detail));
                continue;
            }
            match (&tensor.digest, digests.get(&key)) {
                (Some(recorded), Some(found)) if recorded == found => part.equal = part.equal.saturating_add(1),
                (Some(_), Some(_)) => {
                    let detail = format!("has another {} in {}", self.recorded.hash().title(), tensor.shard);
                    part.differ(&tensor.name, DifferenceKind::Differs, Some(detail));
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
        Ok(part)
    }

    /// Why the merge cannot have been allowed to make a tensor.
    fn stray(&self, tensor: &RecordedTensor) -> Option<String> {
        self.bounds.as_ref().and_then(|bounds| tensor.stray(bounds))
    }

    /// The digests of the recorded tensors that the result has, by shard and name. One that overlaps another one has none:
    /// tensors that overlap could name the same bytes any number of times.
    fn digests(&self) -> Result<BTreeMap<(&'v str, &'v str), String>, VerifyError> {
        let algorithm = self.recorded.hash();
        let hashed = self.recorded.tensors.iter().filter(|tensor| tensor.digest.is_some());
        let wanted: BTreeSet<(&str, &str)> = hashed.map(|t| (t.shard.as_str(), t.name.as_str())).collect();
        let (mut keys, mut jobs) = (Vec::new(), Vec::new());
        for shard in self.result.shards.values() {
            let mut tensors: Vec<&Tensor> = shard.tensors.iter().filter(|t| t.begin <= t.end).collect();
            tensors.sort_by_key(|tensor| (tensor.begin, tensor.end));
            let mut end = 0_u64;
            for tensor in tensors {
                let key = (shard.name.as_str(), tensor.name.as_str());
                if tensor.begin >= end && wanted.contains(&key) {
                    end = tensor.end;
                    keys.push(key);
                    let range = Some((shard.data_start.saturating_add(tensor.begin), tensor.len()));
                    jobs.push(HashJob { source: &self.result.source, name: key.0, range, algorithm });
                }
            }
        }
        let mut digests = BTreeMap::new();
        for (key, found) in keys.into_iter().zip(hash(&jobs)) {
            match found {
                Ok(found) => digests.extend(found.digest.map(|digest| (key, digest))),
                Err(error @ OpenError::Io { .. }) => return Err(error.into()),
                // Reported with the files, or as unverified.
                Err(_) => {}
            }
        }
        Ok(digests)
    }

    /// The files of a donor against the manifest.
    fn donor_files(&mut self, role: &str, donor: &Checkpoint) -> Result<VerifiedPart, VerifyError> {
        let mut part = VerifiedPart::new(&format!("files of donor {role}"));
        let Some(recorded) = self.recorded.donors.get(role) else { return Ok(part) };
        self.compare_files(&donor.source, &recorded.files, &mut part)?;
        let (hashed, others): (BTreeMap<_, _>, BTreeMap<_, _>) =
            recorded.shards.clone().into_iter().partition(|(name, shard)| {
                shard.sha256.is_some() && donor.shards.get(name).is_some_and(|found| has_header(found, shard))
            });
        compare_headers(donor, &others, |_| Ok(()), &mut part);
        let whole = hashed
            .into_iter()
            .filter_map(|(name, shard)| Some((name, RecordedFile { bytes: Some(shard.bytes), sha256: shard.sha256? })));
        self.compare_files(&donor.source, &whole.collect(), &mut part)?;
        Ok(part)
    }

    /// The tensors of the result that stand for those of a donor, recomputed and compared byte for byte.
    fn recomputed(&mut self, role: &str, given: &Given<'_>) -> Result<VerifiedPart, VerifyError> {
        let mut part = VerifiedPart::new(&format!("tensors recomputed from donor {role}"));
        let mut work = Vec::new();
        let mut lacking = BTreeSet::new();
        for tensor in self.recorded.tensors.iter().filter(|tensor| tensor.main().donor == role) {
            let present = self.present.get(&(tensor.shard.as_str(), tensor.name.as_str()));
            // Reported with the tensors of the result.
            let Some((shard, found)) = present.filter(|(_, t)| header_difference(t, tensor).is_none()) else {
                continue;
            };
            let named = self.bounds.as_ref().is_none_or(|bounds| bounds.name_source(&tensor.source));
            let needed = if named { tensor.source.sources() } else { vec![tensor.main()] };
            if let Some(other) = needed.iter().find(|source| !given.donors.contains_key(source.donor.as_str())) {
                lacking.insert((other.donor.as_str(), tensor.name.as_str()));
                continue;
            }
            let planned = planned(tensor, named, found, given).filter(|_| shard.is_whole());
            let at = shard.data_start.saturating_add(found.begin);
            work.push((tensor, planned, self.result.source.path().join(&shard.name), at));
        }
        if let Some((other, first)) = lacking.first() {
            let tensors = count(lacking.len(), "tensor was", "tensors were");
            self.unverified.push(format!(
                "{tensors} not made again, the first one {first}: they are also made from the donor {other}, which is not given"
            ));
        }
        let hash = self.recorded.hash();
        let compared = parallel::map(
            parallel::threads(),
            &work,
            || (),
            |(), (_, planned, result, at)| {
                planned.as_ref().map(|planned| compare(planned, result, *at, hash)).transpose()
            },
        );
        for ((tensor, planned, ..), compared) in work.iter().zip(compared) {
            let (Some(planned), Some(compared)) = (planned, compared?) else {
                let sources = tensor.source.sources().into_iter();
                let lacking = sources.filter(|source| given.tensor(source, false).is_none()).map(|source| &source.name);
                let name = lacking.chain([&tensor.main().name]).next().map_or("", String::as_str);
                let detail = format!("the donor has no {name} that it could be made from");
                part.differ(&tensor.name, DifferenceKind::Missing, Some(detail));
                continue;
            };
            // The digest of a copy is that of its source.
            let copied = tensor.digest.as_ref().filter(|_| tensor.source.copied().is_some());
            let recorded = tensor.source.sources().into_iter().map(|source| source.digest.as_ref().or(copied));
            let mut digests = recorded.zip(&compared.source_digests);
            let is_other_donor = digests.any(|(was, found)| was.zip(found.as_ref()).is_some_and(|(a, b)| a != b));
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

/// The tensors of a donor.
type TensorsByName<'d> = BTreeMap<&'d str, (&'d Shard, &'d Tensor)>;

/// The donors that were given, by role, with their tensors by name.
struct Given<'d> {
    donors: BTreeMap<&'d str, (&'d Path, TensorsByName<'d>)>,
}

impl<'d> Given<'d> {
    fn new(opened: &'d BTreeMap<&'d str, Checkpoint>) -> Self {
        let tensors = |donor: &'d Checkpoint| donor.tensors().map(|(s, t)| (t.name.as_str(), (s, t))).collect();
        let donors = opened.iter().map(|(role, donor)| (*role, (donor.source.path(), tensors(donor))));
        Self { donors: donors.collect() }
    }

    /// A recorded tensor of a donor, or its whole tensor; `None` when the donor has none of that name and type.
    fn tensor(&self, source: &DonorTensor, whole: bool) -> Option<TensorRef> {
        let (root, tensors) = self.donors.get(source.donor.as_str())?;
        let (shard, tensor) = tensors.get(source.name.as_str())?;
        let rows = source.slice.filter(|_| !whole).and_then(|slice| Some([slice.first, *source.shape.first()?]));
        let from = TensorRef::new(&source.donor, root, shard, tensor, rows).ok()?;
        let is_recorded = Dtype::from_name(&source.dtype) == Some(from.dtype) && (whole || from.shape == source.shape);
        (is_recorded && shard.is_whole()).then_some(from)
    }
}

/// Whether a shard has the recorded size and header.
fn has_header(found: &Shard, recorded: &RecordedShard) -> bool {
    found.file_len == recorded.bytes && found.header_sha256() == recorded.header_sha256
}

/// The shards of a checkpoint against recorded sizes and headers; `refused` says why one must not be read.
fn compare_headers(
    checkpoint: &Checkpoint,
    shards: &BTreeMap<String, RecordedShard>,
    refused: impl Fn(&str) -> Result<(), OpenError>,
    part: &mut VerifiedPart,
) {
    for (name, recorded) in shards {
        match (checkpoint.shards.get(name), refused(name)) {
            (None, _) | (_, Err(OpenError::NotFound { .. })) => part.differ(name, DifferenceKind::Missing, None),
            (_, Err(error)) => part.differ(name, DifferenceKind::Differs, Some(error.to_string())),
            (Some(found), Ok(())) if has_header(found, recorded) => part.equal = part.equal.saturating_add(1),
            (Some(_), Ok(())) => {
                part.differ(name, DifferenceKind::Differs, Some("has another size or header".to_owned()));
            }
        }
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

/// The hidden entries of a directory that are not of [`OF_TOOLS`]. A checkpoint does not list them.
fn hidden(source: &Source) -> Result<BTreeSet<String>, OpenError> {
    let io = |error| OpenError::from_io(source.path(), error);
    let names = source.list("").map_err(io)?.map(|entry| entry.map(|entry| entry.name.to_string_lossy().into_owned()));
    let is_hidden = |name: &String| name.starts_with('.') && !OF_TOOLS.contains(&name.as_str());
    names.filter(|name| name.as_ref().map_or(true, is_hidden)).collect::<Result<_, _>>().map_err(io)
}

/// What a manifest before version 4 leaves open: it does not say which tensors the recipe was allowed to change.
fn without_bounds(recorded: &Recorded) -> Option<String> {
    let changed: Vec<&RecordedTensor> = recorded.tensors.iter().filter(|tensor| tensor.is_changed()).collect();
    let (first, _) = changed.split_first()?;
    Some(format!(
        "a manifest of version {} does not say which tensors the recipe was allowed to change: {} recorded as changed, the first one {} ({}), and made again as recorded; merge again to verify the others",
        recorded.schema,
        count(changed.len(), "tensor is", "tensors are"),
        first.name,
        first.source.transform().name(),
    ))
}

/// The plan of a recorded tensor; `None` when a donor's tensor has another type or shape than the recorded one, or the tensor
/// cannot be made from it. One that is not `named` has the donor's values, whatever is recorded.
fn planned(recorded: &RecordedTensor, named: bool, result: &Tensor, given: &Given<'_>) -> Option<PlannedTensor> {
    let source = if named {
        recorded.source.try_map(&mut |of| given.tensor(of, false).ok_or(())).ok()?
    } else {
        let of = given.tensor(recorded.main(), true)?;
        let from = of.dtype;
        TensorExpr::Stored(of).converted(from, None, result.dtype)
    };
    let planned = PlannedTensor::new(recorded.name.clone(), source).ok()?;
    (planned.dtype == result.dtype && planned.shape == result.shape).then_some(planned)
}
