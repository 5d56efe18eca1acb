//! Grammar of `patch-match.cfg` and `fusion.cfg`, as COLMAP 3.8 to 4.x read them
//! (mvs/patch_match.cc, mvs/fusion.cc).
//!
//! `patch-match.cfg`: lines, trimmed; empty ones and those that begin with `#` are skipped; the
//! others are pairs of a reference image and its sources, separated by `,` or `;`. There is no
//! escape, and an empty list of sources would shift all later pairs by a line.

use serde::{Deserialize, Serialize};

use super::as_path;
use crate::backends::{BackendError, error::check_length};

/// Longest end that is put behind the name of an image.
const LONGEST_END: &str = ".photometric.bin";

/// One problem of patch match: the reference image and its sources, never empty.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Problem {
    pub reference: String,
    pub sources: Vec<String>,
}

impl Problem {
    /// Returns the names of all its images.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        let names = [&self.reference].into_iter().chain(&self.sources);
        names.map(String::as_str)
    }
}

/// Returns the text of a `patch-match.cfg`; `heading` becomes comment lines.
pub fn write_patch_match(heading: &[String], problems: &[Problem]) -> String {
    let mut text: String = heading.iter().map(|line| format!("# {line}\n")).collect();
    for problem in problems {
        debug_assert!(!problem.sources.is_empty());
        text += &format!("{}\n{}\n", problem.reference, problem.sources.join(", "));
    }
    text
}

/// Refuses a name that cannot be written to both files, as a reference and as a source.
pub fn check_name(backend: &'static str, name: &str) -> Result<(), BackendError> {
    let why = if name.contains([',', ';']) {
        "`,` and `;` separate names in patch-match.cfg and cannot be escaped"
    } else if name.starts_with('#') {
        "a line that begins with `#` is a comment in patch-match.cfg"
    } else if name.contains(['\n', '\r']) {
        "a line break ends an entry of patch-match.cfg"
    } else if trim(name) != name {
        "blanks at the ends of a name are cut off in patch-match.cfg"
    } else if name == "__all__" || name == "__auto__" {
        "it is a keyword of patch-match.cfg"
    } else {
        return check_length(backend, name, LONGEST_END);
    };
    Err(BackendError::name(backend, name, why))
}

/// Refuses a name in the lists, as [`check_name`], and where COLMAP would write its maps elsewhere.
pub fn check_listed(name: &str) -> Result<(), BackendError> {
    let backend = super::BACKEND.name;
    check_name(backend, name)?;
    if as_path(name).split('/').all(|part| part != "..") {
        return Ok(());
    }
    Err(BackendError::Needs {
        backend,
        what: format!(
            "names in the workspace that lead down only, and {name} has a `..`: its depth map and its normal map may be one file"
        ),
        hint: "rename the images in the model of the workspace, or export with --out DIR, which writes another one".into(),
    })
}

/// COLMAP's `StringTrim` removes ASCII white space only.
fn trim(text: &str) -> &str {
    // Rust's ASCII white space lacks the vertical tab, which C's `isspace` has.
    text.trim_matches(|c: char| c.is_ascii_whitespace() || c == '\x0b')
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::base::error::Hint;

    /// Parses a `patch-match.cfg` as COLMAP does: a last reference without a line of sources is
    /// dropped.
    fn read_patch_match(text: &str) -> Vec<Problem> {
        let lines: Vec<&str> = text
            .lines()
            .map(trim)
            .filter(|l| !l.is_empty() && !l.starts_with('#'))
            .collect();
        let problem = |pair: &[&str]| Problem {
            reference: pair[0].into(),
            sources: pair[1]
                .split([',', ';'])
                .map(trim)
                .filter(|s| !s.is_empty())
                .map(Into::into)
                .collect(),
        };
        lines.chunks_exact(2).map(problem).collect()
    }

    proptest! {
        /// Whatever is written is read back as it was meant.
        #[test]
        fn colmap_empty_source_line_shifts_pairs(
            problems in prop::collection::vec(("[^,;\r\n]{1,8}", prop::collection::vec("[^,;\r\n]{1,8}", 1..5)), 0..6),
        ) {
            let problems: Vec<_> = problems.into_iter().map(|(reference, sources)| Problem { reference, sources }).collect();
            let names = problems.iter().flat_map(|p| std::iter::once(&p.reference).chain(&p.sources));
            prop_assume!(names.into_iter().all(|n| check_name("colmap", n).is_ok()));
            let text = write_patch_match(&["ranked".into()], &problems);
            prop_assert_eq!(read_patch_match(&text), problems);
        }
    }

    fn refused(name: &str) -> bool {
        check_name("colmap", name)
            .is_err_and(|e| e.to_string().contains(name.trim()) && e.hint().is_some())
    }

    #[test]
    fn colmap_comma_in_name() {
        assert!(refused("a,b.jpg"));
    }

    #[test]
    fn colmap_semicolon_in_name() {
        assert!(refused("a;b.jpg"));
    }

    #[test]
    fn colmap_hash_name() {
        assert!(refused("#a.jpg"));
    }

    #[test]
    fn colmap_blank_edge_name() {
        assert!(refused(" a.jpg") && refused("a.jpg\t"));
        assert!(check_name("colmap", "flight 1/a b.jpg").is_ok());
    }
}
