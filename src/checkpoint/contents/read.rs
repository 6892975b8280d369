//! Reads the bytes of all tensors, on all cores.
//!
//! The tensors are divided into parts that any thread reads, so one large shard occupies all cores. The division, and thus
//! each sum, does not depend on the number of threads.

use std::collections::BTreeMap;
use std::num::NonZeroUsize;
use std::sync::atomic::{AtomicBool, Ordering};

use serde::{Deserialize, Serialize};

use super::CHUNK;
use super::pieces::{Piece, WINDOW, each_piece};
use super::tally::{BLOCK, Sums, Tally, as_u64};
use crate::checkpoint::shard::tail::zero_tail;
use crate::checkpoint::{Dtype, Fault, FaultKind, Shard, Source, SourceFile, Tensor, parallel};

/// Bytes of a part: a few milliseconds of work.
const PART: u64 = WINDOW as u64;

/// Maximum number of parts of one checkpoint, besides one for each tensor. Holes make files of any size.
const PARTS: u64 = 1 << 16;

/// What [`read`] does besides looking for damage.
#[derive(Debug, Clone, Copy, Default)]
pub struct ReadOptions {
    /// Whether the numbers are added up.
    pub stats: bool,
    /// Number of threads; one for each core when missing.
    pub threads: Option<NonZeroUsize>,
}

/// Bytes that were read since the last call.
#[derive(Debug, Clone, Copy)]
#[non_exhaustive]
pub struct Progress<'a> {
    /// Name of the file.
    pub file: &'a str,
    /// Bytes of it that were read since the last call.
    pub bytes: u64,
    /// Bytes that the whole run reads.
    pub total: u64,
}

/// The name of an element type in the format. `serde` would borrow a reference that is written here.
type DtypeName = &'static str;

/// What one tensor contains.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[non_exhaustive]
pub struct TensorContents {
    /// Name of its shard.
    pub file: String,
    /// Name of the tensor.
    pub tensor: String,
    /// Element type.
    #[serde(deserialize_with = "Dtype::read_name")]
    pub dtype: DtypeName,
    /// Elements; a complex number counts as two.
    pub elements: u64,
    /// Elements that are NaN.
    pub nan: u64,
    /// Elements that are infinite.
    pub infinite: u64,
    /// Elements that are 0 or -0.
    pub zeros: u64,
    /// Whether every element has the same bits; false without elements.
    pub constant: bool,
    /// Statistics over the finite elements, with `--stats`.
    #[serde(flatten)]
    pub stats: Option<TensorStats>,
}

/// Statistics over the finite elements of one tensor. Those that have no finite value are null.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[non_exhaustive]
pub struct TensorStats {
    /// Smallest element.
    pub min: Option<f64>,
    /// Largest element.
    pub max: Option<f64>,
    /// Mean, computed in double precision.
    pub mean: Option<f64>,
    /// Root of the mean of the squares, computed in double precision.
    pub rms: Option<f64>,
    /// Nonzero elements below the smallest normal number of the element type.
    pub denormals: u64,
}

impl TensorContents {
    fn new(file: &str, tensor: &Tensor, tally: &Tally) -> Self {
        let finite = tally.elements.saturating_sub(tally.nan).saturating_sub(tally.infinite);
        Self {
            file: file.to_owned(),
            tensor: tensor.name.clone(),
            dtype: tensor.dtype.name(),
            elements: tally.elements,
            nan: tally.nan,
            infinite: tally.infinite,
            zeros: tally.zeros,
            constant: tally.is_constant(),
            stats: tally.sums.map(|sums| TensorStats::new(&sums, finite)),
        }
    }
}

impl TensorStats {
    fn new(sums: &Sums, finite: u64) -> Self {
        #[expect(clippy::cast_precision_loss, reason = "a divisor")]
        let count = finite as f64;
        // Adding zero turns -0 into 0.
        let known = |number: f64| Some(number + 0.0).filter(|n| n.is_finite() && finite > 0);
        Self {
            min: known(sums.min),
            max: known(sums.max),
            mean: known(sums.sum / count),
            rms: known((sums.squares / count).sqrt()),
            denormals: sums.denormals,
        }
    }
}

/// The tensors of a shard that are read.
struct ShardPlan {
    file: String,
    file_len: u64,
    data_start: u64,
    /// Indexes of the tensors, in the order of their bytes.
    tensors: Vec<usize>,
    /// Whether more follow that overlap.
    overlap: bool,
}

impl ShardPlan {
    /// `None` for a shard whose offsets are not reliable; its header has faults of its own.
    fn new(shard: &Shard) -> Option<Self> {
        if shard.unread || shard.tensors.is_empty() {
            return None;
        }
        let region = shard.file_len.saturating_sub(shard.data_start);
        // The other tensors of a truncated shard can still be read.
        let mut sorted: Vec<(usize, &Tensor)> =
            shard.tensors.iter().enumerate().filter(|(_, t)| t.begin <= t.end && t.end <= region).collect();
        sorted.sort_by_key(|(_, t)| (t.begin, t.end, t.name.as_str()));
        let mut tensors = Vec::new();
        let mut read = 0_u64;
        let mut last: Option<&Tensor> = None;
        let mut overlap = false;
        for (at, tensor) in sorted {
            // Tensors that overlap could name the same bytes any number of times.
            if !shard.is_contiguous(&tensor.name) {
                continue;
            }
            // Those of a pickle that share a storage whole are read once.
            if shard.is_pickle() && last.is_some_and(|last| (last.begin, last.end) == (tensor.begin, tensor.end)) {
                continue;
            }
            last = Some(tensor);
            read = read.saturating_add(tensor.len());
            overlap = read > region.saturating_mul(2);
            if overlap {
                break;
            }
            tensors.push(at);
        }
        let file = shard.name.clone();
        Some(Self { file, file_len: shard.file_len, data_start: shard.data_start, tensors, overlap })
    }

    fn open(&self, source: &Source) -> Result<SourceFile, String> {
        let file = source.open_regular(&self.file, u64::MAX).map_err(|error| error.to_string())?;
        if file.len() != self.file_len {
            return Err("it changed while it was read".to_owned());
        }
        Ok(file)
    }
}

/// Bytes of one tensor, or none, to see that the shard can be opened.
struct Part<'s> {
    /// Number of the shard.
    shard: usize,
    tensor: Option<&'s Tensor>,
    /// Start and length, counted from the start of the tensor.
    range: (u64, u64),
}

/// Divides the tensors into parts: first one without bytes for each shard, then its tensors in the order of their bytes.
fn parts<'s>(plans: &[ShardPlan], shards: &'s BTreeMap<String, Shard>) -> Vec<Part<'s>> {
    let tensors: Vec<Vec<&Tensor>> = plans
        .iter()
        .map(|plan| {
            let shard = shards.get(&plan.file);
            plan.tensors.iter().filter_map(|at| shard?.tensors.get(*at)).collect()
        })
        .collect();
    let total = tensors.iter().flatten().fold(0_u64, |sum, tensor| sum.saturating_add(tensor.len()));
    let block = as_u64(BLOCK);
    let length = total.checked_div(PARTS).unwrap_or(0).div_ceil(block).saturating_mul(block).max(PART);
    let mut parts = Vec::new();
    for (shard, tensors) in tensors.into_iter().enumerate() {
        parts.push(Part { shard, tensor: None, range: (0, 0) });
        for tensor in tensors {
            let mut at = 0;
            while at < tensor.len() || at == 0 {
                let len = tensor.len().saturating_sub(at).min(length);
                parts.push(Part { shard, tensor: Some(tensor), range: (at, len) });
                at = at.saturating_add(length);
            }
        }
    }
    parts
}

/// What a part contains, or why it could not be read.
type Outcome = Result<Option<Tally>, String>;

/// Reads the bytes of every tensor of `shards`, and adds the faults that only the bytes reveal; `progress` is called by
/// every thread, after each read. Called for `check --deep`. Returns what each tensor contains, by shard and then in the
/// order of their bytes; tensors that share the storage of another in a pickle are left out, and so are those that cannot
/// be read. The result does not depend on the number of threads.
pub(in crate::checkpoint) fn read(
    source: &Source,
    shards: &mut BTreeMap<String, Shard>,
    options: ReadOptions,
    progress: &(dyn Fn(Progress<'_>) + Sync),
) -> Vec<TensorContents> {
    let plans: Vec<ShardPlan> = shards.values().filter_map(ShardPlan::new).collect();
    let parts = parts(&plans, shards);
    let total = parts.iter().fold(0_u64, |sum, part| sum.saturating_add(part.range.1));
    let run = Run { source, plans: &plans, parts: &parts, options, total, progress };
    let outcomes = run.outcomes();
    let mut contents = Vec::new();
    let mut found: Vec<(usize, Vec<Fault>)> = Vec::new();
    let mut pairs = parts.iter().zip(outcomes).peekable();
    for (number, plan) in plans.iter().enumerate() {
        let Some(shard) = shards.get(&plan.file) else { continue };
        let mut faults = Vec::new();
        let mut merged = ShardContents { shard, plan, whole: Vec::new(), error: None };
        while let Some((part, outcome)) = pairs.next_if(|(part, _)| part.shard == number) {
            merged.add(part, outcome);
        }
        merged.finish(&mut faults, &mut contents);
        found.push((number, faults));
    }
    drop(parts);
    for (number, faults) in found {
        let shard = plans.get(number).and_then(|plan| shards.get_mut(&plan.file));
        let Some(shard) = shard else { continue };
        if faults.iter().any(|f| f.kind == FaultKind::ZeroTail) {
            // The header reader may already have reported a part of the zeros, from holes in the file.
            shard.faults.retain(|f| f.kind != FaultKind::ZeroTail);
        }
        shard.faults.extend(faults);
    }
    contents
}

/// What the parts of one shard contain, put together in their order.
struct ShardContents<'s> {
    shard: &'s Shard,
    plan: &'s ShardPlan,
    whole: Vec<(&'s Tensor, Tally)>,
    /// The first error; nothing behind it counts.
    error: Option<String>,
}

impl<'s> ShardContents<'s> {
    fn add(&mut self, part: &Part<'s>, outcome: Outcome) {
        if self.error.is_some() {
            return;
        }
        match (outcome, part.tensor) {
            (Err(reason), tensor) => {
                // The tensor was not read to its end.
                self.whole.pop_if(|(last, _)| tensor.is_some_and(|tensor| std::ptr::eq(*last, tensor)));
                self.error = Some(reason);
            }
            (Ok(Some(tally)), Some(tensor)) => match self.whole.last_mut() {
                Some((last, before)) if std::ptr::eq(*last, tensor) => before.then(&tally),
                _ => self.whole.push((tensor, tally)),
            },
            (Ok(_), _) => {}
        }
    }

    fn finish(self, faults: &mut Vec<Fault>, contents: &mut Vec<TensorContents>) {
        let Self { shard, plan, whole, error } = self;
        let unread = |reason: String| Fault::new(FaultKind::ContentsUnread).at(shard.place()).with("reason", reason);
        let mut last = 0;
        for (tensor, tally) in &whole {
            faults.extend(tally.fault(&shard.name, &tensor.name));
            contents.push(TensorContents::new(&plan.file, tensor, tally));
            if let Some(end) = tally.last_value() {
                last = tensor.begin.saturating_add(end);
            }
        }
        if let Some(reason) = error {
            return faults.push(unread(reason));
        }
        if plan.overlap {
            return faults.push(unread("its tensors overlap".to_owned()));
        }
        if last < shard.file_len.saturating_sub(shard.data_start) && !shard.is_pickle() {
            let mut tensors: Vec<&Tensor> = shard.tensors.iter().filter(|t| t.begin <= t.end).collect();
            tensors.sort_by_key(|t| (t.begin, t.end, t.name.as_str()));
            faults.extend(zero_tail(shard, &tensors, last));
        }
    }
}

/// Reads parts with several threads.
struct Run<'a> {
    source: &'a Source,
    plans: &'a [ShardPlan],
    parts: &'a [Part<'a>],
    options: ReadOptions,
    total: u64,
    progress: &'a (dyn Fn(Progress<'_>) + Sync),
}

impl Run<'_> {
    /// What each part contains. Each thread takes one after the other.
    fn outcomes(&self) -> Vec<Outcome> {
        let failed: Vec<AtomicBool> = self.plans.iter().map(|_| AtomicBool::new(false)).collect();
        // A buffer, and the shard of the last part: most parts have the same one.
        let state = || (vec![0_u8; CHUNK], None::<(usize, SourceFile)>);
        let threads = self.options.threads.map_or_else(parallel::threads, usize::from);
        parallel::map(threads, self.parts, state, |(buffer, open), part| {
            let is_failed = failed.get(part.shard);
            // A part before this one has the reason.
            if is_failed.is_some_and(|failed| failed.load(Ordering::Relaxed)) {
                return Ok(None);
            }
            let outcome = self.part(part, open, buffer);
            if let (Err(_), Some(failed)) = (&outcome, is_failed) {
                failed.store(true, Ordering::Relaxed);
            }
            outcome
        })
    }

    fn part(&self, part: &Part<'_>, open: &mut Option<(usize, SourceFile)>, buffer: &mut [u8]) -> Outcome {
        let Some(plan) = self.plans.get(part.shard) else { return Ok(None) };
        if open.as_ref().is_none_or(|(shard, _)| *shard != part.shard) {
            *open = Some((part.shard, plan.open(self.source)?));
        }
        let (Some((_, file)), Some(tensor)) = (open, part.tensor) else { return Ok(None) };
        let mut tally = Tally::new(tensor.dtype, self.options.stats);
        let start = plan.data_start.saturating_add(tensor.begin).saturating_add(part.range.0);
        let read = each_piece(file, start, part.range.1, buffer, |piece| {
            match &piece {
                Piece::Data(bytes) => tally.add(bytes),
                Piece::Hole(len) => tally.skip(*len),
            }
            (self.progress)(Progress { file: &plan.file, bytes: piece.len(), total: self.total });
        });
        read.map_err(|error| {
            let ended = error.kind() == std::io::ErrorKind::UnexpectedEof;
            if ended { "it became shorter while it was read".to_owned() } else { error.to_string() }
        })?;
        Ok(Some(tally))
    }
}
