//! `docs/files.md`: the files of a checkpoint that have a meaning.

use std::fmt::Write as _;

use ckpt_doctor::checkpoint::file_size;
use ckpt_doctor::checkpoint::files::{FILES, KnownFile, NamePattern};

use super::{GENERATED, fresh};

const TEXT: &str = "\
# Files

What is read of the files of a checkpoint, and for what. The first row that matches a name counts. A file that no row names
is only listed, unless it is a pickle by its first bytes.

A JSON document, text or module above its limit is not read, and is reported. The limits on headers of safetensors files and on
pickles do not depend on the size of the file: see [Security](../SECURITY.md). In folders below the checkpoint, names are
listed and a few documents are read: the configs of the parts of a pipeline, and statistics of robots.
";

fn row(file: &KnownFile) -> String {
    let name = match file.name {
        NamePattern::Exact(name) => name.to_owned(),
        NamePattern::Around(start, end) => format!("{start}*{end}"),
    };
    let object = file.object.map_or("", |object| object.name());
    let limit = Some(file.content.cap()).filter(|cap| *cap < u64::MAX).map(file_size).unwrap_or_default();
    format!("| `{name}` | {} | {object} | {} | {limit} |", file.library.name(), file.content.name())
}

#[test]
fn the_page_of_files_is_fresh() {
    let mut page =
        format!("{GENERATED}\n\n{TEXT}\n| file | opened by | for the | read as | limit |\n|---|---|---|---|---|\n");
    for file in FILES {
        let _ = writeln!(page, "{}", row(file));
    }
    fresh("docs/files.md", &page);
}
