//! Places the tensors of a shard so that file systems can share blocks with the donors.
//!
//! XFS and btrfs copy a range by reference if both files have it at the same offset modulo the size of a block. A header may
//! end with spaces, so a shard can choose where its data starts; the offsets of its tensors then agree with those of one donor's
//! file, and often of several. The plan does not depend on the file system: the same merge has the same bytes everywhere.

use std::cmp::{Ordering, Reverse};
use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::Path;

use super::planned_tensor::PlannedTensor;

/// Size of a block in bytes: that of a page on most systems, and the default of mkfs.
pub const BLOCK: u64 = 4096;

/// Minimum number of bytes that a padded header must allow to share; a copy of fewer costs no time.
const WORTHWHILE: u64 = 1 << 20;

/// Minimum number of bytes that are copied from a file of a donor for shards of its own. A copy of fewer takes a moment, and
/// the result stays one file.
const LARGE: u64 = 256 << 20;

/// The order of tensors in a shard: wider types first; then copies, in the order of the donor's files; then others by name.
#[must_use]
pub fn file_order(a: &PlannedTensor, b: &PlannedTensor) -> Ordering {
    place(a).cmp(&place(b))
}

/// What the order compares. Files by role and name: a path depends on where the donors are.
fn place(tensor: &PlannedTensor) -> impl Ord {
    let copied = tensor.copied();
    let source = copied.map(|from| (from.donor.clone(), from.path.file_name().map(OsStr::to_owned), from.offset));
    (Reverse(tensor.dtype), Reverse(copied.is_some()), source, tensor.name.clone())
}

/// Tensors in an order in which those of one large file of a donor are adjacent, with the number of that file. `None`, and last,
/// for the others; for all if there are not two such files.
///
/// One header can make the offsets of a shard agree with those of one file, so a shard of each file lets the result share the
/// blocks of all of them.
#[must_use]
pub fn by_file(tensors: Vec<PlannedTensor>) -> Vec<(Option<usize>, PlannedTensor)> {
    // The place of the first tensor of each file, which is its number, and the bytes of all.
    let mut files: BTreeMap<&Path, (usize, u64)> = BTreeMap::new();
    for (i, tensor) in tensors.iter().enumerate() {
        let Some(from) = tensor.copied() else { continue };
        let (_, bytes) = files.entry(&from.path).or_insert((i, 0));
        *bytes = bytes.saturating_add(tensor.len());
    }
    files.retain(|_, (_, bytes)| *bytes >= LARGE);
    if files.len() < 2 {
        files.clear();
    }
    let number = |t: &PlannedTensor| files.get(t.copied()?.path.as_path()).map(|(i, _)| *i);
    let numbers: Vec<Option<usize>> = tensors.iter().map(number).collect();
    let mut numbered: Vec<(Option<usize>, PlannedTensor)> = numbers.into_iter().zip(tensors).collect();
    numbered.sort_by_key(|(file, _)| file.unwrap_or(usize::MAX));
    numbered
}

/// A range of a donor's file that goes unchanged into a shard: one tensor or adjacent ones, or a part of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Run<'p> {
    /// The donor's file.
    pub path: &'p Path,
    /// Its first byte there.
    pub from: u64,
    /// Its first byte in the shard.
    pub at: u64,
    /// Number of bytes.
    pub len: u64,
}

impl<'p> Run<'p> {
    /// Adds `next`, if it follows both in the donor's file and in the shard.
    pub fn extend(&mut self, next: Run<'p>) -> bool {
        let follows = self.path == next.path
            && self.from.saturating_add(self.len) == next.from
            && self.at.saturating_add(self.len) == next.at;
        if follows {
            self.len = self.len.saturating_add(next.len);
        }
        follows
    }

    /// The first `len` bytes, and the others.
    #[must_use]
    pub fn split(self, len: u64) -> (Self, Self) {
        let len = len.min(self.len);
        let rest = Self {
            from: self.from.saturating_add(len),
            at: self.at.saturating_add(len),
            len: self.len.saturating_sub(len),
            ..self
        };
        (Self { len, ..self }, rest)
    }

    /// The bytes up to the first whole block, the whole blocks, and the others; without shared blocks, all bytes are others.
    #[must_use]
    pub fn blocks(self) -> [Self; 3] {
        if self.from % BLOCK != self.at % BLOCK {
            let (none, all) = self.split(0);
            return [none, none, all];
        }
        let (head, rest) = self.split(self.at.next_multiple_of(BLOCK).saturating_sub(self.at));
        let (whole, tail) = rest.split(rest.len.saturating_sub(rest.len % BLOCK));
        [head, whole, tail]
    }
}

/// The residue of the data's offset with which a shard of these tensors shares most bytes with donors; `None` if that is not
/// worth a padded header.
#[must_use]
pub fn residue(tensors: &[PlannedTensor]) -> Option<u64> {
    let mut shared: BTreeMap<u64, u64> = BTreeMap::new();
    let mut add = |run: Run<'_>| {
        // The offset at which the data must start for this run; `at` counts from there.
        let residue = (run.from % BLOCK).saturating_add(BLOCK).saturating_sub(run.at % BLOCK) % BLOCK;
        let [_, whole, _] = Run { at: run.from, ..run }.blocks();
        let bytes = shared.entry(residue).or_default();
        *bytes = bytes.saturating_add(whole.len);
    };
    let mut open: Option<Run<'_>> = None;
    let mut at = 0_u64;
    for tensor in tensors {
        let len = tensor.len();
        if let Some(from) = tensor.copied() {
            let run = Run { path: &from.path, from: from.offset, at, len };
            if !open.as_mut().is_some_and(|open| open.extend(run)) {
                open.replace(run).into_iter().for_each(&mut add);
            }
        }
        at = at.saturating_add(len);
    }
    open.into_iter().for_each(add);
    let usable = shared.into_iter().filter(|(residue, bytes)| residue.is_multiple_of(8) && *bytes >= WORTHWHILE);
    // The smallest of equal ones.
    usable.max_by_key(|(residue, bytes)| (*bytes, BLOCK.saturating_sub(*residue))).map(|(residue, _)| residue)
}

#[cfg(test)]
#[allow(clippy::arithmetic_side_effects, reason = "small numbers")]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::checkpoint::Dtype;
    use crate::surgery::plan::{PlannedShard, into_shards};
    use crate::surgery::tensor_ref::TensorRef;

    const MIB: u64 = 1 << 20;

    /// A tensor of bytes at an offset of a donor's file.
    fn tensor(path: &str, offset: u64, len: u64) -> PlannedTensor {
        let from = TensorRef {
            donor: "a".to_owned(),
            path: PathBuf::from(path),
            name: String::new(),
            dtype: Dtype::U8,
            shape: vec![len],
            offset,
            len,
            slice: None,
        };
        PlannedTensor::copy(format!("{path} {offset}"), from)
    }

    /// The only shard of these tensors, and where its data starts.
    fn shard(tensors: Vec<PlannedTensor>) -> (PlannedShard, u64) {
        let shard = into_shards(tensors, u64::MAX).remove(0);
        let header = shard.header();
        assert_eq!(shard.file_len(), header.len() as u64 + shard.data_len());
        assert_eq!(shard.preview().file_len, shard.file_len());
        assert!((header.len() as u64).is_multiple_of(8));
        // The reference implementation takes the header with its spaces.
        let mut file = header.clone();
        file.resize(usize::try_from(shard.file_len()).unwrap(), 0);
        assert_eq!(safetensors::SafeTensors::deserialize(&file).unwrap().len(), shard.tensors.len());
        (shard, header.len() as u64)
    }

    #[test]
    fn the_header_ends_where_most_bytes_can_be_shared() {
        // Two runs of one donor agree, and have more bytes than the other one.
        let (_, at) = shard(vec![tensor("x", 800, MIB), tensor("x", 800 + 2 * MIB, MIB), tensor("y", 16, 3 * MIB / 2)]);
        assert_eq!(at % BLOCK, 800);
        let (_, at) = shard(vec![tensor("x", 800, MIB), tensor("y", 16 + MIB, 3 * MIB)]);
        assert_eq!((at + MIB) % BLOCK, 16);
        // A residue of any value fits: the header grows by less than a block.
        for residue in (0..BLOCK).step_by(8) {
            let (shard, at) = shard(vec![tensor("x", 8 * BLOCK + residue, 2 * MIB)]);
            assert_eq!(at % BLOCK, residue);
            assert!(at < BLOCK + 8 + PlannedShard { data_start: None, ..shard }.header().len() as u64);
        }
    }

    #[test]
    fn a_header_is_padded_only_where_it_is_worthwhile() {
        for tensors in [vec![tensor("x", 800, MIB / 2)], vec![tensor("x", 801, 3 * MIB)], Vec::new()] {
            assert_eq!(residue(&tensors), None);
        }
        assert_eq!(residue(&[tensor("x", 800, 3 * MIB).started()]), None);
    }

    #[test]
    fn copies_have_the_order_of_the_donor_and_come_before_others() {
        let tensors = vec![tensor("a", 0, 1).started(), tensor("y", 5, 1), tensor("x", 100, 1), tensor("x", 9, 1)];
        let (shard, _) = shard(tensors);
        let names: Vec<&str> = shard.tensors.iter().map(|t| t.name.as_str()).collect();
        assert_eq!(names, ["x 9", "x 100", "y 5", "a 0"]);
    }

    #[test]
    fn large_files_of_donors_have_shards_of_their_own() {
        let large = |path, offset| tensor(path, offset, LARGE);
        let made = tensor("x", 1 << 40, 2 * MIB).started();
        let tensors = vec![large("x", 800), tensor("z", 8, MIB), large("y", 16), made, large("x", 800 + LARGE)];
        let names = |shards: &[PlannedShard]| -> Vec<Vec<String>> {
            shards.iter().map(|s| s.tensors.iter().map(|t| t.name.clone()).collect()).collect()
        };
        let shards = into_shards(tensors.clone(), u64::MAX);
        let second = ["y 16".to_owned(), "z 8".to_owned(), format!("x {}", 1_u64 << 40)];
        assert_eq!(names(&shards), [vec!["x 800".to_owned(), format!("x {}", 800 + LARGE)], second.to_vec()]);
        for (shard, residue) in shards.iter().zip([800, 16]) {
            assert_eq!(shard.header().len() as u64 % BLOCK, residue);
        }
        // The limit holds as well, and one large file alone needs no shard.
        assert_eq!(names(&into_shards(tensors.clone(), LARGE)).len(), 4);
        let alone = tensors.into_iter().filter(|t| !t.name.starts_with('y')).collect();
        assert_eq!(names(&into_shards(alone, u64::MAX)).len(), 1);
    }

    #[test]
    fn a_run_is_cut_at_whole_blocks() {
        let cut = |from, at, len| {
            let run = Run { path: Path::new("x"), from, at, len };
            run.blocks().map(|part| (part.from, part.at, part.len))
        };
        let (a, b) = (BLOCK, 2 * BLOCK);
        assert_eq!(cut(a, b, BLOCK), [(a, b, 0), (a, b, BLOCK), (b, 3 * BLOCK, 0)]);
        let [head, whole, tail] = cut(a + 10, b + 10, 2 * BLOCK);
        assert_eq!(
            (head, whole, tail),
            ((a + 10, b + 10, BLOCK - 10), (b, 3 * BLOCK, BLOCK), (b + BLOCK, 4 * BLOCK, 10))
        );
        assert_eq!(cut(a + 10, b + 10, 5), [(a + 10, b + 10, 5), (a + 15, b + 15, 0), (a + 15, b + 15, 0)]);
        assert_eq!(cut(a + 10, b + 11, BLOCK)[2], (a + 10, b + 11, BLOCK));
    }
}
