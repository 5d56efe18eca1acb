//! The floors inside the crates, whose own order the compiler holds: each folder of `src/` uses
//! only those below it, and so does each section of the method (`ARCHITECTURE.md`).

use std::{
    collections::BTreeSet,
    fs,
    path::{Path, PathBuf},
};

/// From the ground up.
const FLOORS: [&str; 8] = [
    "base", "config", "plan", "backends", "show", "apps", "daemon", "cli",
];
/// The sections of the method, from the ground up.
const SECTIONS: [&str; 11] = [
    "surface",
    "visibility",
    "region",
    "target",
    "geometry",
    "confidence",
    "fulfilment",
    "partners",
    "pilot",
    "ranking",
    "synthetic",
];

/// The source files under a folder, tests left out.
fn sources(folder: &Path) -> Vec<PathBuf> {
    let files = walkdir::WalkDir::new(folder)
        .sort_by_file_name()
        .into_iter()
        .map(|entry| entry.unwrap().into_path());
    let is_test = |path: &Path| {
        path.ends_with("tests.rs") || path.parent().is_some_and(|p| p.ends_with("tests"))
    };
    let is_source = |path: &PathBuf| path.extension().is_some_and(|e| e == "rs") && !is_test(path);
    files.filter(is_source).collect()
}

/// The code of a file without its comments and its tests.
fn code(path: &Path) -> String {
    let text = fs::read_to_string(path).unwrap();
    let product = text
        .split("#[cfg(test)]\nmod tests {")
        .next()
        .unwrap_or_default();
    product
        .lines()
        .map(|line| line.split("//").next().unwrap_or_default())
        .collect::<Vec<_>>()
        .join("\n")
}

/// The first two names of each path that begins with `crate::`, in use trees too.
fn uses(code: &str) -> BTreeSet<(String, String)> {
    let trees = code.split("crate::").skip(1);
    trees
        .flat_map(leaves)
        .map(|path| (path[0].clone(), path.get(1).cloned().unwrap_or_default()))
        .collect()
}

/// The paths of a use tree, as far as it goes: `a::{b, c::d}` gives `[a, b]` and `[a, c, d]`.
fn leaves(tree: &str) -> Vec<Vec<String>> {
    let tree = tree.trim_start();
    let Some(inner) = tree.strip_prefix('{') else {
        let end = tree
            .find(|c: char| !c.is_alphanumeric() && c != '_')
            .unwrap_or(tree.len());
        let (name, rest) = (tree[..end].to_owned(), &tree[end..]);
        let below = rest.strip_prefix("::").map(leaves).unwrap_or_default();
        return if below.is_empty() {
            vec![vec![name]]
        } else {
            below
                .into_iter()
                .map(|path| [vec![name.clone()], path].concat())
                .collect()
        };
    };
    let (mut depth, mut start, mut found) = (0, 0, Vec::new());
    for (i, c) in inner.char_indices() {
        match c {
            '{' => depth += 1,
            ',' | '}' if depth == 0 => {
                found.extend(
                    Some(&inner[start..i])
                        .filter(|part| !part.trim().is_empty())
                        .into_iter()
                        .flat_map(leaves),
                );
                start = i + 1;
                if c == '}' {
                    break;
                }
            }
            '}' => depth -= 1,
            _ => {}
        }
    }
    found
}

#[test]
fn use_trees_are_taken_apart() {
    let found = uses(
        "use crate::{base::{self, error::Hint}, io::ply};\nfn f() { crate::plan::Plan::new() }",
    );
    let expected = [
        ("base", "error"),
        ("base", "self"),
        ("io", "ply"),
        ("plan", "Plan"),
    ];
    assert_eq!(found, expected.map(|(a, b)| (a.into(), b.into())).into());
}

#[test]
fn each_floor_uses_only_those_below_it() {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let folders = fs::read_dir(&source).unwrap().map(|entry| entry.unwrap());
    let folders: BTreeSet<String> = folders
        .filter(|entry| entry.file_type().unwrap().is_dir())
        .map(|entry| entry.file_name().into_string().unwrap())
        .collect();
    assert_eq!(folders, FLOORS.map(String::from).into());
    let mut climbs = Vec::new();
    for (height, floor) in FLOORS.iter().enumerate() {
        for path in sources(&source.join(floor)) {
            let above = uses(&code(&path))
                .into_iter()
                .filter(|(used, _)| FLOORS[height + 1..].contains(&used.as_str()));
            climbs.extend(above.map(|(used, name)| format!("{}: {used}::{name}", path.display())));
        }
    }
    assert!(climbs.is_empty(), "{climbs:#?}");
}

#[test]
fn each_section_of_the_method_uses_only_those_before_it() {
    let method = Path::new(env!("CARGO_MANIFEST_DIR")).join("crates/core/src/method");
    let mut climbs = Vec::new();
    for (height, section) in SECTIONS.iter().enumerate() {
        for path in sources(&method).into_iter().filter(|path| {
            let inside = path
                .strip_prefix(&method)
                .unwrap()
                .components()
                .next()
                .unwrap()
                .as_os_str();
            Path::new(inside).with_extension("") == Path::new(section)
        }) {
            let later = uses(&code(&path)).into_iter().filter(|(floor, used)| {
                floor == "method" && SECTIONS[height + 1..].contains(&used.as_str())
            });
            climbs.extend(later.map(|(_, used)| format!("{}: {used}", path.display())));
        }
    }
    assert!(climbs.is_empty(), "{climbs:#?}");
}
