//! The order of a plan in the cells of a cloud that OpenMVS really fused (`benches/cells.py`), so
//! that a worse ranking is seen within seconds.

use std::{fs, path::Path, process::Command};

/// Which maps take part in which cells: names of the maps, and rows of the number of cells and the
/// bits of the maps that take part in them.
struct Incidence {
    names: Vec<String>,
    rows: Vec<(u64, u64)>,
}

impl Incidence {
    fn read(path: &Path) -> Self {
        let text = fs::read_to_string(path).unwrap();
        let mut lines = text.lines();
        let names = lines
            .next()
            .unwrap()
            .split('\t')
            .map(String::from)
            .collect();
        let row = |line: &str| {
            let mut words = line.split('\t');
            let cells = words.next().unwrap().parse().unwrap();
            (
                cells,
                u64::from_str_radix(words.next_back().unwrap(), 16).unwrap(),
            )
        };
        Self {
            names,
            rows: lines.map(row).collect(),
        }
    }

    /// Share of the cells in which two of the maps take part.
    fn covered(&self, names: &[&str]) -> f64 {
        let bit = |name: &&str| 1 << self.names.iter().position(|own| own == name).unwrap();
        let chosen: u64 = names.iter().map(bit).sum();
        let all: u64 = self.rows.iter().map(|row| row.0).sum();
        let hit: u64 = self
            .rows
            .iter()
            .filter(|row| (row.1 & chosen).count_ones() >= 2)
            .map(|row| row.0)
            .sum();
        hit as f64 / all as f64
    }

    /// So many maps, evenly spread over the names; `offset` 0 or 0.5.
    fn every_nth(&self, number: usize, offset: f64) -> Vec<&str> {
        let mut names: Vec<&str> = self.names.iter().map(String::as_str).collect();
        names.sort_unstable();
        let place = |i: usize| ((i as f64 + offset) * names.len() as f64 / number as f64) as usize;
        (0..number).map(|i| names[place(i)]).collect()
    }
}

/// Names of the key views of a plan for OpenMVS of the whole fixture, in rank order.
fn ranked() -> Vec<String> {
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/valley");
    let project = tempfile::tempdir().unwrap();
    for entry in walkdir::WalkDir::new(&fixture)
        .min_depth(1)
        .sort_by_file_name()
    {
        let entry = entry.unwrap();
        let target = project
            .path()
            .join(entry.path().strip_prefix(&fixture).unwrap());
        if entry.file_type().is_dir() {
            fs::create_dir(target).unwrap();
        } else {
            fs::copy(entry.path(), target).unwrap();
        }
    }
    let mut command = Command::new(env!("CARGO_BIN_EXE_viewrank"));
    command.arg("plan").arg(project.path());
    command.args([
        "--backend",
        "openmvs",
        "--budget",
        "100%",
        "--target",
        "100%",
        "--quiet",
    ]);
    let done = command
        .env("XDG_CONFIG_HOME", env!("CARGO_TARGET_TMPDIR"))
        .output()
        .unwrap();
    assert!(
        done.status.success(),
        "{}",
        String::from_utf8_lossy(&done.stderr)
    );
    let manifest = fs::read(project.path().join("viewrank/manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_slice(&manifest).unwrap();
    let key = |cluster: &serde_json::Value| cluster["key"].as_str().unwrap().to_owned();
    manifest["clusters"]
        .as_array()
        .unwrap()
        .iter()
        .map(key)
        .collect()
}

#[test]
fn the_first_maps_cover_more_of_a_real_cloud_than_evenly_spread_ones() {
    let table =
        Incidence::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/valley_cells.tsv"));
    let ranked = ranked();
    let order: Vec<&str> = ranked.iter().map(String::as_str).collect();
    assert_eq!(table.covered(&order), 1.0, "the table is of all maps");
    // Beyond two thirds of the maps both have nearly all.
    for number in 2..=order.len() * 2 / 3 {
        let spread = [0.0, 0.5].map(|offset| table.covered(&table.every_nth(number, offset)));
        let ours = table.covered(&order[..number]);
        assert!(
            ours > (spread[0] + spread[1]) / 2.0,
            "{number} maps: {ours:.3}, evenly spread {spread:.3?}"
        );
    }
}
