//! Pickles of torch.
//!
//! The first byte selects the input: 255 is a whole file; 254 is the pickle of the old format behind its head; any other
//! value is the member `data.pkl` of an archive with three storages of that many bytes. Most random archives would be invalid.

#![no_main]

#[path = "../../tests/it/support/invariants.rs"]
mod invariants;
#[path = "../../tests/it/support/pickle.rs"]
mod pickle;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let Some((mode, rest)) = data.split_first() else { return };
    match mode {
        255 => invariants::pickle::hold(rest),
        254 => invariants::pickle::hold(&[pickle::LEGACY_HEAD, rest].concat()),
        len => {
            let mut members = vec![("archive/data.pkl".to_owned(), rest.to_vec())];
            for key in 0..3 {
                members.push((format!("archive/data/{key}"), vec![0; usize::from(*len)]));
            }
            members.push(("archive/version".to_owned(), b"3\n".to_vec()));
            invariants::pickle::hold(&pickle::archive(&members));
        }
    }
});
