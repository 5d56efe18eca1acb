//! README.md shows what the program prints.

use std::{fs, path::Path};

use super::valley::{printed, project};

/// The lines of a plan in the README, from the first of the summary to the end of its table.
fn shown() -> Vec<String> {
    let readme = Path::new(env!("CARGO_MANIFEST_DIR")).join("README.md");
    let text = fs::read_to_string(readme).unwrap();
    let block = text
        .split_once("plan fixtures/valley --backend openmvs\n")
        .unwrap()
        .1;
    let lines = block
        .lines()
        .map(str::trim)
        .skip_while(|line| line.is_empty());
    let lines: Vec<String> = lines.map(str::to_owned).collect();
    let end = lines
        .iter()
        .position(|line| line.ends_with("100 %"))
        .unwrap();
    lines[..=end].to_vec()
}

#[test]
fn the_plan_in_the_readme_is_the_one_that_is_printed() {
    let folder = project();
    let path = folder.path().to_str().unwrap();
    let plan = printed(&["plan", path, "--backend", "openmvs"]);
    let plan: Vec<&str> = plan.lines().map(str::trim).collect();
    for line in shown() {
        assert!(
            plan.contains(&&*line),
            "{line}\nis not in\n{}",
            plan.join("\n")
        );
    }
}
