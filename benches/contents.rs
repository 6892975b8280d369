//! Measures reading the contents of tensors: `cargo bench --bench contents [-- DIRECTORY]`
//!
//! Without a directory, the bench writes a checkpoint of 2 GB of random numbers and removes it again. The rounds take turns, so
//! that a disturbance meets all of them; the page cache must be able to hold the files. Each line has the median rate, the
//! processor time of all threads for one GB, and the rate as a share of its bound. The bound of reading is a plain sum over a
//! memory map of the same files by all cores. The hashes are those of `verify` and of `check --hash`, over parts of the same map.
//!
//! The environment variable `DTYPE` chooses the element type of the numbers; the default is `BF16`.

#![allow(clippy::print_stdout, reason = "a bench prints its result")]
#![allow(unsafe_code, reason = "the map is what the reader is compared with; nobody changes the files of the bench")]
#![allow(
    clippy::arithmetic_side_effects,
    clippy::cast_precision_loss,
    clippy::disallowed_methods,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a bench stops at the first error"
)]

use std::fs::{self, File};
use std::hint::black_box;
use std::io::{BufWriter, Write as _};
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::Instant;

use ckpt_doctor::checkpoint::{Checkpoint, Dtype, ReadOptions};
use memmap2::{Mmap, MmapOptions};
use multiversion::multiversion;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng as _};
use sha1::Sha1;
use sha2::{Digest, Sha256};

/// Bytes that a thread takes at a time.
const PART: u64 = 24 << 20;
const ROUNDS: usize = 7;

fn main() {
    let given = std::env::args().skip(1).find(|a| !a.starts_with("--"));
    let made = given.is_none().then(|| tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a directory"));
    let dir = given.map_or_else(|| made.as_ref().expect("made").path().to_owned(), PathBuf::from);
    if made.is_some() {
        write(&dir);
    }
    let checkpoint = Checkpoint::open(&dir).expect("a checkpoint");
    let files: Vec<File> = checkpoint.shards.keys().map(|name| File::open(dir.join(name)).expect("a shard")).collect();
    let bytes = checkpoint.shards.values().map(|shard| shard.file_len).sum::<u64>();
    drop(checkpoint);
    let read = |stats: bool| {
        let mut checkpoint = Checkpoint::open(&dir).expect("a checkpoint");
        checkpoint.read_contents(ReadOptions { stats, ..ReadOptions::default() }, &|_| {});
        black_box(checkpoint.contents.len());
    };
    let runs: [(&str, &dyn Fn()); 9] = [
        ("bound: sum of a memory map, unmapping not counted", &|| map(&files)),
        ("sum of windows of a memory map", &|| windows(&files)),
        ("sum of positioned reads of 1 MB", &|| reads(&files)),
        ("check --deep", &|| read(false)),
        ("check --stats", &|| read(true)),
        ("sum of a memory map", &|| drop(map_and(&files, sum))),
        ("SHA-256 of a memory map", &|| drop(map_and(&files, first_byte::<Sha256>))),
        ("SHA-1 of a memory map, as of git", &|| drop(map_and(&files, first_byte::<Sha1>))),
        ("BLAKE3 of a memory map", &|| drop(map_and(&files, |bytes| blake3::hash(bytes).as_bytes()[0].into()))),
    ];
    let mut results = vec![Vec::new(); runs.len()];
    for round in 0..=ROUNDS {
        for ((_, run), results) in runs.iter().zip(&mut results) {
            let (begun, cpu) = (Instant::now(), processor_time());
            run();
            let elapsed = UNMAPPING.swap(0, Ordering::Relaxed);
            let elapsed = begun.elapsed().as_secs_f64() - elapsed as f64 / 1e9;
            // The first round fills the page cache.
            if round > 0 {
                results.push((bytes as f64 / elapsed / 1e9, (processor_time() - cpu) / (bytes as f64 / 1e9)));
            }
        }
    }
    let median = |results: &[(f64, f64)], of: fn(&(f64, f64)) -> f64| {
        let mut sorted: Vec<f64> = results.iter().map(of).collect();
        sorted.sort_by(f64::total_cmp);
        sorted[sorted.len() / 2]
    };
    let bound = median(&results[0], |r| r.0);
    println!("{:.2} GB, {} threads, median of {ROUNDS} rounds", bytes as f64 / 1e9, threads());
    for ((name, _), results) in runs.iter().zip(&results) {
        let (rate, cpu) = (median(results, |r| r.0), median(results, |r| r.1));
        println!("{name:50} {rate:6.2} GB/s {:6.1} ms/GB {:5.2} of the bound", cpu * 1e3, rate / bound);
    }
}

/// Nanoseconds that the last run spent on what is not counted.
static UNMAPPING: AtomicU64 = AtomicU64::new(0);

fn threads() -> usize {
    thread::available_parallelism().map_or(1, usize::from)
}

/// Calls `work` with parts of the files, in all threads.
fn each_part(files: &[File], work: impl Fn(usize, u64, u64) -> u64 + Sync) {
    let lengths = files.iter().map(|file| file.metadata().expect("metadata").len());
    let parts: Vec<(usize, u64, u64)> = lengths
        .enumerate()
        .flat_map(|(n, len)| (0..len.div_ceil(PART)).map(move |part| (n, part * PART, len.min((part + 1) * PART))))
        .collect();
    let next = AtomicU64::new(0);
    thread::scope(|scope| {
        for _ in 0..threads() {
            scope.spawn(|| {
                while let Some((file, start, end)) =
                    parts.get(usize::try_from(next.fetch_add(1, Ordering::Relaxed)).expect("small"))
                {
                    black_box(work(*file, *start, *end));
                }
            });
        }
    });
}

fn at(n: u64) -> usize {
    usize::try_from(n).expect("a place in memory")
}

/// Calls `work` with the parts of maps of the files, in all threads.
fn map_and(files: &[File], work: impl Fn(&[u8]) -> u64 + Sync) -> Vec<Mmap> {
    // SAFETY: the files are those of the bench.
    let maps: Vec<Mmap> = files.iter().map(|file| unsafe { Mmap::map(file) }.expect("a map")).collect();
    each_part(files, |file, start, end| work(&maps[file][at(start)..at(end)]));
    maps
}

fn map(files: &[File]) {
    let maps = map_and(files, sum);
    let begun = Instant::now();
    drop(maps);
    UNMAPPING.store(u64::try_from(begun.elapsed().as_nanos()).expect("short"), Ordering::Relaxed);
}

fn windows(files: &[File]) {
    each_part(files, |file, start, end| {
        // SAFETY: as above.
        let window = unsafe { MmapOptions::new().offset(start).len(at(end - start)).map(&files[file]) };
        sum(&window.expect("a map"))
    });
}

fn reads(files: &[File]) {
    each_part(files, |file, start, end| {
        let mut buffer = vec![0; 1 << 20];
        (start..end).step_by(buffer.len()).fold(0, |all, from| {
            let len = buffer.len().min(at(end - from));
            files[file].read_exact_at(&mut buffer[..len], from).expect("a read");
            sum(&buffer[..len]).wrapping_add(all)
        })
    });
}

#[multiversion(targets("x86_64+avx2+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn sum(bytes: &[u8]) -> u64 {
    let mut lanes = [0_u64; 32];
    for row in bytes.as_chunks::<256>().0 {
        for (lane, word) in lanes.iter_mut().zip(row.as_chunks().0) {
            *lane = lane.wrapping_add(u64::from_le_bytes(*word));
        }
    }
    lanes.into_iter().fold(0, u64::wrapping_add)
}

/// Hashes the bytes. The result is only for the compiler, which must not leave the work out.
fn first_byte<D: Digest>(bytes: &[u8]) -> u64 {
    D::digest(bytes)[0].into()
}

/// Seconds of all threads of this process, from `/proc/self/stat`; 0 where there is none.
fn processor_time() -> f64 {
    let stat = fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let numbers = stat.rsplit(')').next().unwrap_or_default().split_whitespace();
    numbers.skip(11).take(2).filter_map(|ticks| ticks.parse::<f64>().ok()).sum::<f64>() / 100.0
}

/// Writes four shards, each with tensors of one element type and values around zero.
fn write(dir: &Path) {
    let dtype = std::env::var("DTYPE").ok().and_then(|name| Dtype::from_name(&name)).unwrap_or(Dtype::BF16);
    let mut random = ChaCha8Rng::seed_from_u64(1);
    for shard in 1..=4 {
        // Elements of six bits fill three bytes.
        let (rows, tensors) = (24_u64, 21);
        let size = rows << 20;
        let columns = size * 8 / dtype.bits() / rows;
        let entry = |n: u64| {
            let (begin, end) = (n * size, (n + 1) * size);
            format!(
                r#""layer.{n}.weight":{{"dtype":"{dtype}","shape":[{rows},{columns}],"data_offsets":[{begin},{end}]}}"#
            )
        };
        let header = format!("{{{}}}", (0..tensors).map(entry).collect::<Vec<_>>().join(","));
        let name = dir.join(format!("model-{shard:05}-of-00004.safetensors"));
        let mut file = BufWriter::new(File::create(name).expect("a file"));
        file.write_all(&(header.len() as u64).to_le_bytes()).expect("a write");
        file.write_all(header.as_bytes()).expect("a write");
        let mut block = vec![0_u8; 1 << 20];
        for _ in 0..tensors * rows {
            random.fill_bytes(&mut block);
            if let Some(width) = float_width(dtype) {
                // Exponents around that of one: all are finite.
                block.chunks_exact_mut(width).for_each(|bytes| bytes[width - 1] = bytes[width - 1] & 0x83 | 0x3c);
            }
            file.write_all(&block).expect("a write");
        }
        file.flush().expect("a write");
    }
}

/// Bytes of a float of this type; `None` for integers, and for floats that share a byte.
fn float_width(dtype: Dtype) -> Option<usize> {
    match dtype {
        Dtype::F64 => Some(8),
        Dtype::F32 | Dtype::C64 => Some(4),
        Dtype::F16 | Dtype::BF16 => Some(2),
        Dtype::F8_E4M3 | Dtype::F8_E5M2 => Some(1),
        _ => None,
    }
}
