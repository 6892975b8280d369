//! The space that a new shard needs on a file system that shares blocks between files.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;

use super::system::KernelCopy;
use crate::surgery::align::Run;
use crate::surgery::plan::PlannedShard;

/// Whether new files in a directory can share blocks with donors.
pub(super) struct Sharing {
    /// Device of the target, if its file system shares blocks.
    dev: Option<u64>,
}

impl Sharing {
    pub(super) fn of(dir: &Path) -> Self {
        let opened = File::open(dir).ok().filter(|opened| KernelCopy::of(opened) == KernelCopy::Shares);
        let dev = opened.and_then(|opened| Some(opened.metadata().ok()?.dev()));
        Self { dev }
    }

    /// Number of bytes of a new shard that need space.
    pub(super) fn space(&self, shard: &PlannedShard) -> u64 {
        shard.file_len().saturating_sub(self.shared(shard))
    }

    /// Number of bytes of a shard that need no space: whole blocks of tensors of donors on the same device.
    fn shared(&self, shard: &PlannedShard) -> u64 {
        let Some(dev) = self.dev else { return 0 };
        let mut devices: BTreeMap<&Path, bool> = BTreeMap::new();
        let mut at = shard.header().len() as u64;
        let mut shared = 0_u64;
        for tensor in &shard.tensors {
            let len = tensor.len();
            if let Some(from) = tensor.copied() {
                let path = from.path.as_path();
                let is_here = || fs::metadata(path).is_ok_and(|m| m.dev() == dev);
                if *devices.entry(path).or_insert_with(is_here) {
                    let [_, whole, _] = Run { path, from: from.offset, at, len }.blocks();
                    shared = shared.saturating_add(whole.len);
                }
            }
            at = at.saturating_add(len);
        }
        shared
    }
}
