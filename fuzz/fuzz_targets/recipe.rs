//! Recipes from end to end: parsed, planned on two tiny donors and, for every fourth input, written, opened and checked.
//!
//! The first byte selects whether the merge is written; the rest is the recipe.

#![no_main]

mod merging;

use std::collections::BTreeMap;

use ckpt_doctor::knowledge::recipe::Recipe;
use ckpt_doctor::merge::MergeRequest;
use libfuzzer_sys::fuzz_target;
use merging::{PLACE, hold};

fuzz_target!(|data: &[u8]| {
    let Some((mode, rest)) = data.split_first() else { return };
    let Some(recipe) = std::str::from_utf8(rest).ok().and_then(|text| Recipe::parse("recipe.json5", text).ok()) else {
        return;
    };
    let roles = recipe.donors.iter().map(|donor| donor.role.clone());
    let donors = roles.zip(["a", "b"].into_iter().cycle()).map(|(role, name)| (role, PLACE.join(name))).collect();
    let dry_run = mode % 4 != 0;
    let (out, options) = (PLACE.join("out"), BTreeMap::new());
    hold(&MergeRequest { recipe: Some(recipe), donors, options, versions: Vec::new(), tolerate: Vec::new(), out, dry_run, hash: Default::default(), hash_donors: mode % 8 == 0 });
});
