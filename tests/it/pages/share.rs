//! `packaging/data/share/`: the completions and manual pages that packages install.

use std::collections::BTreeSet;

use super::fresh;
use crate::support::{files, project};

fn printed(args: &[&str]) -> String {
    let output = crate::support::program().args(args).output().expect("the program");
    assert!(output.status.success(), "{args:?}: {output:?}");
    String::from_utf8(output.stdout).expect("text")
}

#[test]
fn completions_and_manual_pages_are_fresh() {
    let completions = [
        ("bash", "packaging/data/share/bash-completion/completions/ckpt-doctor"),
        ("zsh", "packaging/data/share/zsh/site-functions/_ckpt-doctor"),
        ("fish", "packaging/data/share/fish/vendor_completions.d/ckpt-doctor.fish"),
    ];
    for (shell, path) in completions {
        fresh(path, &printed(&["completions", shell]));
    }
    let page = printed(&["man"]);
    let commands = page.lines().filter_map(|line| line.strip_prefix(r"ckpt\-doctor\-")?.strip_suffix("(1)"));
    let mut written = BTreeSet::from(["ckpt-doctor.1".to_owned()]);
    for command in commands.map(|name| name.replace('\\', "")) {
        let file = format!("ckpt-doctor-{command}.1");
        fresh(&format!("packaging/data/share/man/man1/{file}"), &printed(&["man", &command]));
        written.insert(file);
    }
    fresh("packaging/data/share/man/man1/ckpt-doctor.1", &page);
    assert!(written.contains("ckpt-doctor-build-merged.1"), "{written:?}");
    let found = files(&project().join("packaging/data/share/man/man1"), ".1");
    let found = found.iter().map(|path| path.file_name().expect("a name").to_string_lossy().into_owned()).collect();
    assert_eq!(written, found, "remove the page of a command that no longer exists");
}
