//! Observers run in any order.

use ckpt_doctor::check::engine::check_for;
use ckpt_doctor::check::observe::RunOrder;
use ckpt_doctor::check::options::RunOptions;

use super::cases;
use crate::support::{Draw, knowledge, on_cases, open};

/// Any order of the observers, and of the explainers behind them, gives the same outcome.
#[test]
fn the_order_of_observers_changes_nothing() {
    let knowledge = knowledge();
    let share = usize::try_from(cases(12)).unwrap();
    let is_drawn = |name: &str| Draw::new(name.bytes().map(u64::from).sum()).below(1200) < share * 10;
    let differing = on_cases(&knowledge, is_drawn, |_, case, made| {
        let (checkpoint, outcome) = open(made, case.deep, &[], &knowledge);
        let table = format!("{outcome:?}");
        let mut draw = Draw::new(case.name.bytes().map(u64::from).sum::<u64>() + 1);
        (0..2).all(|_| {
            let order = RunOrder::Drawn(u64::try_from(draw.below(1 << 30)).unwrap());
            format!("{:?}", check_for(&checkpoint, &knowledge, &RunOptions { order, ..RunOptions::default() })) == table
        })
    });
    assert!(differing.len() >= 50, "only {} cases were drawn", differing.len());
    let wrong: Vec<&str> = differing.iter().filter(|(_, same)| !same).map(|(case, _)| case.name.as_str()).collect();
    assert!(wrong.is_empty(), "{wrong:?}");
}
