//! The fuzz targets on stable Rust: valid files, changed at random. A short run by default;
//! VIEWRANK_FUZZ_SECONDS is the time per target, VIEWRANK_FUZZ_TARGET one of them.

#[path = "../../fuzz/readers.rs"]
mod readers;

#[path = "../../fuzz/inputs.rs"]
mod inputs;

#[path = "../../fuzz/apps.rs"]
mod apps;

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    time::{Duration, Instant},
};

use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde_json::{Value, json};

/// Changes per target in a normal run.
const CHANGES: u64 = 3000;
/// The same of files that take a while to read.
const FEW_CHANGES: u64 = 300;
/// The same of whole commands.
const FEWEST_CHANGES: u64 = 25;
/// Bytes from which a file takes a while.
const LONG: usize = 1 << 14;
/// Bytes that a head may have.
const HEAD: usize = 256;

/// Values that break things: counts, ids, floating-point numbers.
const VALUES: [u64; 19] = [
    0,
    1,
    2,
    255,
    1 << 31,
    u32::MAX as u64,
    1 << 32,
    1 << 60,
    u64::MAX - 1,
    u64::MAX,
    0x7ff0_0000_0000_0000,
    0x7ff8_0000_0000_0000,
    0x0000_0000_0000_0001,
    0x7fef_ffff_ffff_ffff,
    // In f32: infinity, not a number, the largest, the smallest normal, -1.
    0x7f80_0000,
    0x7fc0_0000,
    0x7f7f_ffff,
    0x0080_0000,
    0xbf80_0000,
];
const TOKENS: [&str; 16] = [
    "0",
    "-1",
    "-0",
    "nan",
    "inf",
    "1e999",
    "-1e308",
    "5e-324",
    "18446744073709551615",
    "18446744073709551616",
    "4294967295",
    "#",
    "CAMERA",
    "IMU",
    "../../x",
    "\u{1F4A9}",
];

struct Chance(Pcg64Mcg);

impl Chance {
    fn below(&mut self, n: usize) -> usize {
        (self.0.next_u64() % n.max(1) as u64) as usize
    }
}

fn change(data: &mut Vec<u8>, text: bool, chance: &mut Chance) {
    // The head of a long file decides most.
    let reach = if chance.below(3) == 0 {
        data.len().min(HEAD)
    } else {
        data.len()
    };
    let at = chance.below(reach + 1);
    let length = chance.below(64).min(data.len() - at);
    match chance.below(if text { 9 } else { 7 }) {
        0 => data.truncate(at),
        1 if at < data.len() => data[at] ^= 1 << chance.below(8),
        2 if at < data.len() => data[at] = chance.below(256) as u8,
        3 => _ = data.drain(at..at + length),
        4 => {
            let piece = data[at..at + length].to_vec();
            let to = chance.below(data.len() + 1);
            data.splice(to..to, piece);
        }
        5 => {
            let value = VALUES[chance.below(VALUES.len())].to_le_bytes();
            let size = [1, 4, 8][chance.below(3)];
            let end = (at + size).min(data.len());
            data[at..end].copy_from_slice(&value[..end - at]);
        }
        6 => {
            let bytes: Vec<u8> = (0..chance.below(16))
                .map(|_| chance.below(256) as u8)
                .collect();
            data.splice(at..at, bytes);
        }
        7 => {
            // A whole token becomes another one.
            let start = data[..at]
                .iter()
                .rposition(|b| b.is_ascii_whitespace())
                .map_or(0, |p| p + 1);
            let end = data[at..]
                .iter()
                .position(|b| b.is_ascii_whitespace())
                .map_or(data.len(), |p| at + p);
            data.splice(start..end, TOKENS[chance.below(TOKENS.len())].bytes());
        }
        _ => data.insert(at, b" \n\r\t"[chance.below(4)]),
    }
}

/// Replaces a value somewhere in a JSON text.
fn change_json(data: &mut Vec<u8>, chance: &mut Chance) {
    if let Ok(mut json) = serde_json::from_slice::<Value>(data) {
        change_value(&mut json, chance);
        *data = json.to_string().into_bytes();
    }
}

fn change_value(value: &mut Value, chance: &mut Chance) {
    let deeper = chance.below(6) > 0;
    match value {
        Value::Array(list) if deeper && !list.is_empty() => {
            let chosen = chance.below(list.len());
            if chance.below(8) == 0 {
                let copy = list[chosen].clone();
                return list.insert(chance.below(list.len()), copy);
            }
            change_value(&mut list[chosen], chance);
        }
        Value::Object(fields) if deeper && !fields.is_empty() => {
            let chosen = chance.below(fields.len());
            change_value(
                fields.values_mut().nth(chosen).expect("below the length"),
                chance,
            );
        }
        _ => {
            let numbers = [
                json!(-1),
                json!(0),
                json!(0.5),
                json!(17),
                json!(1e300),
                json!(u64::MAX),
            ];
            let others = [
                json!(null),
                json!(true),
                json!(""),
                json!("../x"),
                json!([]),
                json!({}),
            ];
            let both = [numbers, others].concat();
            *value = both[chance.below(both.len())].clone();
        }
    }
}

#[derive(Clone, Copy, PartialEq)]
enum Grammar {
    Binary,
    Text,
    Json,
}

/// Changes a valid file again and again and has each change read.
fn fuzz(target: &str, valid: &[u8], grammar: Grammar, read: impl Fn(&[u8])) {
    let is_slow = inputs::INPUTS
        .iter()
        .any(|(name, _)| *name == target && !name.starts_with("map."));
    let changes = match () {
        () if apps::APPS.contains(&target) => FEWEST_CHANGES,
        () if is_slow || valid.len() >= LONG => FEW_CHANGES,
        () => CHANGES,
    };
    let seconds = std::env::var("VIEWRANK_FUZZ_SECONDS")
        .ok()
        .and_then(|s| s.parse().ok())
        .map(Duration::from_secs);
    // The long runs differ from each other.
    let seed = seconds.map_or(1, |_| std::process::id().into());
    let mut chance = Chance(Pcg64Mcg::seed_from_u64(seed));
    let start = Instant::now();
    let mut done = 0u64;
    while seconds.map_or(done < changes, |seconds| start.elapsed() < seconds) {
        let mut data = valid.to_vec();
        for _ in 0..=chance.below(4) {
            // Bytes last: what isn't JSON any more has no values.
            match grammar {
                Grammar::Json if chance.below(4) > 0 => change_json(&mut data, &mut chance),
                _ => change(&mut data, grammar != Grammar::Binary, &mut chance),
            }
        }
        if catch_unwind(AssertUnwindSafe(|| read(&data))).is_err() {
            panic!("{target}: fails with {}", data.escape_ascii());
        }
        done += 1;
    }
    eprintln!(
        "{target}: {done} inputs in {:.0} s",
        start.elapsed().as_secs_f64()
    );
}

fn wanted(target: &str) -> bool {
    std::env::var("VIEWRANK_FUZZ_TARGET")
        .ok()
        .is_none_or(|only| only == target)
}

#[test]
fn changed_files_are_errors_or_models() {
    for target in readers::TARGETS.into_iter().filter(|target| wanted(target)) {
        let text = target.ends_with("txt");
        let files = readers::model(text);
        let valid = &files.iter().find(|f| f.0 == target).unwrap().1;
        let grammar = if text { Grammar::Text } else { Grammar::Binary };
        fuzz(target, valid, grammar, |data| {
            readers::replace(target, data, &files)
        });
    }
}

#[test]
fn changed_files_of_other_programs_are_errors_or_models() {
    for target in readers::FOREIGN.into_iter().filter(|target| wanted(target)) {
        let grammar = if target == "scene.mvs" {
            Grammar::Binary
        } else {
            Grammar::Text
        };
        fuzz(target, &readers::foreign_model(target), grammar, |data| {
            readers::read_foreign(target, data)
        });
    }
}

#[test]
fn changed_inputs_beside_the_model_are_errors_or_consistent() {
    for (target, valid) in inputs::INPUTS
        .into_iter()
        .filter(|(target, _)| wanted(target))
    {
        assert!(inputs::read_input(target, valid), "{target}");
        let grammar = match target {
            "viewrank.toml" => Grammar::Text,
            _ if inputs::is_json(target) => Grammar::Json,
            _ => Grammar::Binary,
        };
        fuzz(target, valid, grammar, |data| {
            _ = inputs::read_input(target, data)
        });
    }
}

#[test]
fn commands_over_changed_files_end_with_an_error_or_numbers() {
    if !apps::APPS.iter().any(|target| wanted(target)) {
        return;
    }
    let finished = apps::Finished::new();
    for target in apps::APPS.into_iter().filter(|target| wanted(target)) {
        let valid = finished.valid(target);
        assert!(finished.run(target, &valid), "{target}");
        let grammar = match target.rsplit('.').next() {
            Some("report") => Grammar::Json,
            Some("clusters") => Grammar::Text,
            _ => Grammar::Binary,
        };
        fuzz(target, &valid, grammar, |data| {
            _ = finished.run(target, data)
        });
    }
}

#[test]
fn changed_regions_are_errors_or_regions() {
    if wanted("region") {
        fuzz(
            "region",
            readers::REGION.as_bytes(),
            Grammar::Json,
            readers::read_region,
        );
    }
}

#[test]
fn the_valid_model_is_read() {
    for text in [false, true] {
        let files = readers::model(text);
        for (name, bytes) in &files {
            readers::replace(name, bytes, &files);
        }
    }
    readers::FOREIGN
        .into_iter()
        .for_each(|name| readers::read_foreign(name, &readers::foreign_model(name)));
}
