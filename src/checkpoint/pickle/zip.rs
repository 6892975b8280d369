//! The zip archives that `torch.save` writes: members are stored without compression, so a storage is a range of the file.
//!
//! Only the directory at the end of the archive is believed; nothing is ever inflated. Format: APPNOTE.TXT 6.3.10. What
//! torch requires: `caffe2/serialize/inline_container.cc` of torch 2.15.0.

use std::collections::HashMap;

use super::machine::{Machine, StorageIds};
use super::storage::{Storages, Stored, claimed};
use super::{PICKLE_CAP, PickleReader, Problem, beside, state_dict};
use crate::checkpoint::SourceFile;
use crate::checkpoint::work::Work;

/// Maximum number of bytes of the directory of an archive; 100 000 members take some 10 MB.
const DIRECTORY_CAP: u64 = 32 << 20;
/// Bytes of the end record without its comment, and of the longest comment.
const END: u64 = 22;
const MAX_COMMENT: u64 = 65_535;
/// Size of the blocks in which torch searches the end record from the end of the file; the last one starts before the longest
/// comment. Beyond the first one it fails for some lengths of the file.
const BLOCK: u64 = 4096;
/// Maximum number of bytes of a member that holds a number or a word.
const WORD_CAP: u64 = 64;

/// Flags of a member that torch does not read: encrypted, a patch, strongly encrypted, masked.
const REFUSED_FLAGS: u16 = 1 | 1 << 5 | 1 << 6 | 1 << 13;

/// A member of an archive.
#[derive(Debug, Clone, Copy)]
struct Member {
    /// By the attribute of DOS; torch reads nothing of one.
    is_folder: bool,
    is_stored: bool,
    /// Number of the part of the archive that it is in: 0 or 1.
    disk: u16,
    bytes: u64,
    packed: u64,
    /// Start of its local header.
    header: u64,
}

/// The directory of an archive.
struct Archive {
    /// The folder in which all members are.
    folder: String,
    /// Members by their name in lower case: torch finds them without regard to case.
    members: HashMap<String, Member>,
    /// Start of the directory: members end before it.
    directory: u64,
    /// What torch opens and never writes, so that the load is not predicted.
    doubt: Option<&'static str>,
    /// Whether two members have one name.
    has_twins: bool,
}

/// Members that hold a number or a word.
const WORDS: [&str; 6] =
    ["version", ".data/version", ".format_version", ".data/serialization_id", ".storage_alignment", "byteorder"];

/// The doubt about an archive of which torch may read either of two members.
const TWINS: &str = "two members of the archive have one name";

fn malformed(reason: &str, offset: u64) -> Problem {
    Problem::Malformed(reason.to_owned(), offset)
}

/// Reads an archive into the reader's shard.
pub(super) fn read(reader: &mut PickleReader<'_>, file: &SourceFile, work: &mut Work) -> Result<(), Problem> {
    let archive = Archive::read(file)?;
    if archive.member("constants.pkl").is_some() {
        return Err(Problem::Other("a TorchScript archive".to_owned()));
    }
    let member =
        archive.member("data.pkl").ok_or_else(|| Problem::Other("a zip archive without data.pkl".to_owned()))?;
    reader.pickle.doubt = archive.doubt.map(str::to_owned);
    if archive.has_twins {
        reader.pickle.unread = Some(beside::hidden(&reader.shard.name, TWINS));
    }
    if !member.is_stored {
        return Ok(());
    }
    if archive.doubt.is_none() {
        archive.check_version(file)?;
    }
    let range = archive.range(file, member)?;
    if range.bytes > PICKLE_CAP {
        return Err(Problem::TooLarge("bytes"));
    }
    if !reader.budget.spend(range.bytes) {
        return Ok(());
    }
    let bytes = file.bytes(range.begin, range.bytes)?;
    work.grant(range.bytes);
    let mut machine = Machine::new(&bytes, StorageIds::Zip, work);
    let result = machine.run();
    reader.record(&machine);
    if archive.has_twins {
        // Which of them torch reads is unknown.
        return Ok(());
    }
    if let Err(stop) = result {
        reader.pickle.unread = beside::unread(&reader.shard.name, &machine, stop, false);
    }
    let value = result.map_err(|stop| Problem::of(stop, machine.offset, None))?;
    if claimed(&machine).is_err() {
        // With a map of the file, as transformers asks for, torch takes the first size; without one it raises.
        reader.pickle.doubt = Some("one storage has two sizes".to_owned());
        return Ok(());
    }
    let storages = storages(reader, file, &archive, &machine)?;
    state_dict::read(reader, &mut machine, value, &storages)
}

/// Finds the storages of a pickle among the members.
fn storages(
    reader: &mut PickleReader<'_>,
    file: &SourceFile,
    archive: &Archive,
    machine: &Machine<'_>,
) -> Result<Storages, Problem> {
    let mut storages = Storages { is_big_endian: archive.is_big_endian(file)?, ..Storages::default() };
    let mut ranges: Vec<(u64, u64)> = Vec::new();
    for (key, bytes) in claimed(machine)? {
        let Some(member) = archive.member(&format!("data/{key}")) else {
            reader.storage_fault(&key, None, bytes, None);
            continue;
        };
        if !member.is_stored || member.is_folder {
            // The archive has a doubt.
            continue;
        }
        let range = archive.range(file, member)?;
        if member.bytes == bytes {
            ranges.push((member.header, range.begin.saturating_add(range.bytes)));
            storages.by_key.insert(key, range);
        } else {
            reader.storage_fault(&key, None, bytes, Some(member.bytes));
        }
    }
    ranges.sort_unstable();
    let overlap = ranges.iter().zip(ranges.iter().skip(1)).find(|((_, end), (start, _))| start < end);
    match overlap {
        Some((_, (start, _))) => Err(malformed("two members of the archive overlap", *start)),
        None => Ok(storages),
    }
}

impl Archive {
    fn read(file: &SourceFile) -> Result<Self, Problem> {
        let end = EndRecord::find(file)?;
        if end.bytes > DIRECTORY_CAP {
            return Err(Problem::TooLarge("members"));
        }
        let bytes = file.bytes(end.directory, end.bytes)?;
        let mut fields = Fields { bytes: &bytes, at: 0, base: end.directory };
        let mut archive = Self {
            folder: String::new(),
            members: HashMap::new(),
            directory: end.directory,
            doubt: end.doubt,
            has_twins: false,
        };
        for number in 0..end.members {
            let offset = fields.offset();
            let (name, member) = fields.member()?;
            if number == 0 {
                let (folder, _) =
                    name.split_once('/').ok_or_else(|| Problem::Other("a zip archive of plain files".to_owned()))?;
                folder.clone_into(&mut archive.folder);
            }
            if !name.strip_prefix(archive.folder.as_str()).is_some_and(|rest| rest.starts_with('/')) {
                return Err(malformed("a member of the archive is in another folder", offset));
            }
            if member.header.saturating_add(30).saturating_add(member.packed) > end.directory {
                return Err(malformed("a member of the archive lies outside of it", offset));
            }
            archive.add(&name, member);
        }
        Ok(archive)
    }

    /// Keeps a member, and notes what is unusual about it.
    fn add(&mut self, name: &str, member: Member) {
        let folded = name.to_ascii_lowercase();
        let inside = folded.get(self.folder.len().saturating_add(1)..).unwrap_or_default();
        let is_storage = inside.starts_with("data/");
        let is_read = is_storage || inside == "data.pkl" || WORDS.contains(&inside);
        let doubt = if is_read && !member.is_stored {
            Some("its members are compressed")
        } else if is_read && name.get(self.folder.len().saturating_add(1)..) != Some(inside) {
            Some("names of its members have other letters in upper case than torch writes")
        } else if (is_storage || [".format_version", ".data/serialization_id"].contains(&inside)) && member.is_folder {
            Some("a member that is read has the attribute of a folder")
        } else if member.disk == 1 {
            Some("a member names another part of the archive")
        } else {
            None
        };
        if self.members.insert(folded, member).is_some() {
            self.has_twins = true;
            self.doubt = self.doubt.or(Some(TWINS));
        }
        self.doubt = self.doubt.or(doubt);
    }

    fn member(&self, name: &str) -> Option<Member> {
        self.members.get(&format!("{}/{name}", self.folder).to_ascii_lowercase()).copied()
    }

    /// The bytes of a member, which its local header precedes.
    fn range(&self, file: &SourceFile, member: Member) -> Result<Stored, Problem> {
        let outside = || malformed("a member of the archive lies outside of it", member.header);
        let header: [u8; 30] = file.array(member.header)?;
        if member.is_folder {
            return Err(malformed("a member of the archive is a folder", member.header));
        }
        if !header.starts_with(b"PK\x03\x04") {
            return Err(malformed("a member of the archive has no header", member.header));
        }
        let fields = Fields { bytes: &header, at: 26, base: member.header };
        let (name, extra) = (fields.peek_u16(26), fields.peek_u16(28));
        let begin = member.header.saturating_add(30).saturating_add(u64::from(name)).saturating_add(u64::from(extra));
        let end = begin.checked_add(member.packed).ok_or_else(outside)?;
        if end > self.directory {
            return Err(outside());
        }
        Ok(Stored { begin, bytes: member.packed })
    }

    /// The content of a member that is a word; `None` when it is missing.
    fn word(&self, file: &SourceFile, name: &str) -> Result<Option<Vec<u8>>, Problem> {
        let Some(member) = self.member(name) else { return Ok(None) };
        if !member.is_stored {
            // The archive has a doubt.
            return Ok(None);
        }
        let range = self.range(file, member)?;
        if range.bytes > WORD_CAP {
            return Err(malformed("a member of the archive that states a number has another content", member.header));
        }
        file.bytes(range.begin, range.bytes).map(Some)
    }

    /// The format version, which torch requires to be 1 to 10, and other numbers that it parses.
    fn check_version(&self, file: &SourceFile) -> Result<(), Problem> {
        let number = |word: Vec<u8>| String::from_utf8(word).ok()?.trim_end().parse::<u64>().ok();
        let version = match self.word(file, ".data/version")? {
            Some(word) => Some(word),
            None => self.word(file, "version")?,
        };
        let version = version.and_then(number);
        if !version.is_some_and(|version| (1..=10).contains(&version)) {
            return Err(malformed("the archive states no version that torch reads", self.directory));
        }
        self.word(file, ".format_version")?;
        let id = self.word(file, ".data/serialization_id")?;
        if id.is_some_and(|id| std::str::from_utf8(&id).is_err()) {
            return Err(malformed("the id of the archive is not UTF-8", self.directory));
        }
        let alignment = self.word(file, ".storage_alignment")?;
        if alignment.is_some_and(|word| number(word).is_none()) {
            return Err(malformed("the archive states no alignment", self.directory));
        }
        Ok(())
    }

    fn is_big_endian(&self, file: &SourceFile) -> Result<bool, Problem> {
        match self.word(file, "byteorder")?.as_deref() {
            None | Some(b"little") => Ok(false),
            Some(b"big") => Ok(true),
            Some(_) => Err(malformed("the archive states no byte order", self.directory)),
        }
    }
}

/// The end record of an archive.
struct EndRecord {
    members: u64,
    /// Start and length of the directory.
    directory: u64,
    bytes: u64,
    doubt: Option<&'static str>,
}

/// Whether Python's `zipfile.is_zipfile` finds an end record, for which transformers asks torch to map a file, and torch
/// refuses those of the old format. Some versions of Python look at the directory, too.
///
/// Source: `load_state_dict` in `modeling_utils.py` of transformers 4.47, 4.57 and 5.23; `_EndRecData` in `Lib/zipfile` of
/// `CPython` 3.11 to 3.13.
pub(super) fn has_end_record(file: &SourceFile) -> Result<bool, Problem> {
    let len = file.len().min(END.saturating_add(MAX_COMMENT));
    let tail = file.bytes(file.len().saturating_sub(len), len)?;
    let at = memchr::memmem::rfind(&tail, b"PK\x05\x06");
    Ok(at.and_then(|at| tail.get(at..)).is_some_and(|record| record.first_chunk::<22>().is_some()))
}

impl EndRecord {
    /// Searches the end record from the end of the file.
    fn find(file: &SourceFile) -> Result<Self, Problem> {
        let cut = || Problem::Cut("the directory at the end of the archive".to_owned(), None);
        let tail_len = file.len().min(END.saturating_add(MAX_COMMENT).saturating_add(BLOCK));
        let start = file.len().saturating_sub(tail_len);
        let tail = file.bytes(start, tail_len)?;
        // A record has 22 bytes; torch passes over a later signature.
        let complete = tail.get(..tail.len().saturating_sub(18)).unwrap_or_default();
        let at = memchr::memmem::rfind(complete, b"PK\x05\x06").ok_or_else(cut)?;
        let record = tail.get(at..).and_then(<[u8]>::first_chunk::<22>).ok_or_else(cut)?;
        let position = start.saturating_add(u64::try_from(at).unwrap_or(u64::MAX));
        let fields = Fields { bytes: record, at: 0, base: position };
        let is_far = file.len().saturating_sub(position) > BLOCK;
        let disks = (fields.peek_u16(4), fields.peek_u16(6));
        let doubt = match disks {
            _ if is_far => Some("its end record is far from its end"),
            (1, 1) => Some("its end record calls it a part of an archive"),
            _ => None,
        };
        let narrow = Self {
            members: u64::from(fields.peek_u16(10)),
            directory: u64::from(fields.peek_u32(16)),
            bytes: u64::from(fields.peek_u32(12)),
            doubt,
        };
        let wide = Self::wide(file, position)?;
        let is_alone = match disks {
            (0, 0) | (1, 1) => true,
            // Then torch reads the numbers of the 64-bit record.
            (0 | u16::MAX, 0 | u16::MAX) => wide.is_some(),
            _ => false,
        };
        if !is_alone || fields.peek_u16(8) != fields.peek_u16(10) {
            return Err(malformed("the archive is a part of several", position));
        }
        let (end, limit) = wide.map_or((narrow, position), |(wide, limit)| (Self { doubt, ..wide }, limit));
        let is_inside = end.directory.checked_add(end.bytes).is_some_and(|stop| stop <= limit);
        if !is_inside || end.members.saturating_mul(46) > end.bytes {
            return Err(malformed("the directory of the archive is not where its end record says", position));
        }
        Ok(end)
    }

    /// The record of an archive with 64-bit numbers, and its position; `None` when there is no locator for it before the
    /// end record.
    fn wide(file: &SourceFile, position: u64) -> Result<Option<(Self, u64)>, Problem> {
        let Some(at) = position.checked_sub(20) else { return Ok(None) };
        let locator: [u8; 20] = file.array(at)?;
        if !locator.starts_with(b"PK\x06\x07") {
            return Ok(None);
        }
        let wrong = || malformed("the 64-bit end record is not where its locator says", at);
        let record_at = Fields { bytes: &locator, at: 0, base: at }.peek_u64(8);
        if record_at.checked_add(56).is_none_or(|end| end > at) {
            return Err(wrong());
        }
        let record: [u8; 56] = file.array(record_at)?;
        if !record.starts_with(b"PK\x06\x06") {
            return Err(wrong());
        }
        let fields = Fields { bytes: &record, at: 0, base: record_at };
        let disks = Fields { bytes: &locator, at: 0, base: at }.peek_u32(16);
        let is_alone = disks == 1 && fields.peek_u64(16) == 0 && fields.peek_u64(24) == fields.peek_u64(32);
        if !is_alone || fields.peek_u64(4) < 44 {
            return Err(malformed("the archive is a part of several", record_at));
        }
        let end = Self {
            members: fields.peek_u64(32),
            directory: fields.peek_u64(48),
            bytes: fields.peek_u64(40),
            doubt: None,
        };
        Ok(Some((end, record_at)))
    }
}

/// Little-endian fields of a record.
struct Fields<'b> {
    bytes: &'b [u8],
    at: usize,
    /// Position of the first byte in the file.
    base: u64,
}

impl<'b> Fields<'b> {
    fn offset(&self) -> u64 {
        self.base.saturating_add(u64::try_from(self.at).unwrap_or(u64::MAX))
    }

    fn peek<const N: usize>(&self, at: usize) -> [u8; N] {
        self.bytes.get(at..).and_then(<[u8]>::first_chunk).copied().unwrap_or([0; N])
    }

    fn peek_u16(&self, at: usize) -> u16 {
        u16::from_le_bytes(self.peek(at))
    }

    fn peek_u32(&self, at: usize) -> u32 {
        u32::from_le_bytes(self.peek(at))
    }

    fn peek_u64(&self, at: usize) -> u64 {
        u64::from_le_bytes(self.peek(at))
    }

    fn take(&mut self, len: usize) -> Result<&'b [u8], Problem> {
        let end = self.at.checked_add(len);
        let bytes = end.and_then(|end| self.bytes.get(self.at..end));
        let bytes = bytes.ok_or_else(|| malformed("the directory of the archive ends early", self.offset()))?;
        self.at = self.at.saturating_add(len);
        Ok(bytes)
    }

    /// One entry of the directory: the name and the member.
    fn member(&mut self) -> Result<(String, Member), Problem> {
        let offset = self.offset();
        let head = Fields { bytes: self.take(46)?, at: 0, base: offset };
        if !head.bytes.starts_with(b"PK\x01\x02") {
            return Err(malformed("the directory of the archive has another entry", offset));
        }
        let (flags, method, disk) = (head.peek_u16(8), head.peek_u16(10), head.peek_u16(34));
        if flags & REFUSED_FLAGS != 0 || disk > 1 {
            return Err(malformed("a member of the archive is encrypted, a patch, or in another archive", offset));
        }
        let name = self.take(usize::from(head.peek_u16(28)))?;
        let extra = self.take(usize::from(head.peek_u16(30)))?;
        self.take(usize::from(head.peek_u16(32)))?;
        let narrow = [head.peek_u32(24), head.peek_u32(20), head.peek_u32(42)];
        let [bytes, packed, header] =
            widened(narrow, extra).ok_or_else(|| malformed("a member has no size", offset))?;
        let (is_folder, is_stored) = (head.peek_u32(38) & 0x10 != 0, method == 0);
        if is_stored && bytes != packed {
            return Err(malformed("a member of the archive has two sizes", offset));
        }
        let name = std::str::from_utf8(name).map_err(|_| malformed("a name in the archive is not UTF-8", offset))?;
        let name = name.to_owned();
        Ok((name, Member { is_folder, is_stored, disk, bytes, packed, header }))
    }
}

/// Size, packed size and position of a member; 64-bit numbers in the extra field replace those of all ones, in this order.
fn widened(narrow: [u32; 3], extra: &[u8]) -> Option<[u64; 3]> {
    let mut fields = Fields { bytes: extra, at: 0, base: 0 };
    let mut wide: &[u8] = &[];
    while fields.at.saturating_add(4) <= extra.len() {
        let (id, len) = (fields.peek_u16(fields.at), fields.peek_u16(fields.at.saturating_add(2)));
        fields.take(4).ok()?;
        let field = fields.take(usize::from(len)).ok()?;
        if id == 1 {
            wide = field;
        }
    }
    let mut numbers = [0; 3];
    for (number, narrow) in numbers.iter_mut().zip(narrow) {
        if narrow == u32::MAX {
            let (first, rest) = wide.split_first_chunk::<8>()?;
            *number = u64::from_le_bytes(*first);
            wide = rest;
        } else {
            *number = u64::from(narrow);
        }
    }
    Some(numbers)
}
