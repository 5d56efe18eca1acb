//! The backends for people: those of the first page, and the table of docs/programs.md.

use super::BACKENDS;

/// Number of backends, from the first of [`BACKENDS`], whose names help and errors give.
pub const FIRST_PAGE: usize = 6;

/// The newest version of a program that was run here on what viewrank writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LastRun {
    At {
        /// Year, month, day.
        date: &'static str,
        version: &'static str,
        /// The parts that were run, and those that were not.
        what: &'static str,
    },
    /// Never; what the export is based on instead.
    Never(&'static str),
}

impl LastRun {
    /// Says whether it was run, first.
    pub fn describe(self) -> String {
        match self {
            Self::At {
                date,
                version,
                what,
            } => format!("run {date}: {version}; {what}"),
            Self::Never(basis) => format!("never run; {basis}"),
        }
    }
}

/// Returns the names on the first page, and how many there are besides.
pub fn names() -> String {
    let first: Vec<&str> = BACKENDS[..FIRST_PAGE].iter().map(|b| b.name).collect();
    format!(
        "{} and {} others (docs/programs.md)",
        first.join(", "),
        BACKENDS.len() - FIRST_PAGE
    )
}

#[cfg(test)]
mod tests {
    use std::{env, fs, path::Path};

    use super::*;
    use crate::backends::Backend;

    /// A row of docs/programs.md.
    fn row(backend: &Backend) -> String {
        let capabilities = backend.capabilities;
        let honoured = [
            capabilities.partners,
            capabilities.key_subset,
            capabilities.order,
        ]
        .map(|honours| format!("{honours:?}").to_lowercase());
        format!(
            "| {} | [{}](../integrations/{}/README.md) | {} | {} |\n",
            backend.program,
            backend.name,
            folder(backend.name),
            honoured.join(" | "),
            backend.last_run.describe()
        )
    }

    /// Folder of a backend below `integrations/`.
    fn folder(name: &str) -> &str {
        match name {
            "pairs" | "patchmatchnet" | "acmm" => "mvsnet",
            name => name,
        }
    }

    /// The tables of docs/programs.md, those of the first page first.
    fn tables() -> [String; 2] {
        const HEAD: &str = "| program | backend | exact partners | key views only | rank order | run here |\n\
                            | --- | --- | --- | --- | --- | --- |\n";
        let (first, others) = BACKENDS.split_at(FIRST_PAGE);
        [first, others].map(|backends| {
            let rows = backends.iter().map(|backend| row(backend));
            HEAD.to_owned() + &rows.collect::<String>()
        })
    }

    #[test]
    fn docs_programs_has_the_tables_of_the_backends() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/programs.md");
        let mut text = fs::read_to_string(&path).unwrap();
        for (name, table) in ["first", "others"].iter().zip(tables()) {
            let begin = format!("<!-- {name} -->\n");
            let (before, rest) = text.split_once(&begin).expect("the begin of a table");
            let (found, after) = rest.split_once("<!-- end -->").expect("the end of a table");
            if env::var_os("VIEWRANK_WRITE_DOCS").is_none() {
                assert_eq!(found, table, "VIEWRANK_WRITE_DOCS=1 writes the tables");
            }
            text = format!("{before}{begin}{table}<!-- end -->{after}");
        }
        if env::var_os("VIEWRANK_WRITE_DOCS").is_some() {
            fs::write(&path, text).unwrap();
        }
    }

    #[test]
    fn every_backend_has_a_folder_with_a_readme_and_a_date_of_its_run() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        for backend in BACKENDS {
            let readme = root.join(format!("integrations/{}/README.md", folder(backend.name)));
            assert!(readme.is_file(), "{}", readme.display());
            if let LastRun::At { date, .. } = backend.last_run {
                let parts: Vec<usize> = date.split('-').map(str::len).collect();
                assert_eq!(parts, [4, 2, 2], "{date}");
            }
        }
    }

    #[test]
    fn the_first_page_is_named_and_the_others_counted() {
        assert_eq!(
            names(),
            "colmap, openmvs, odm, metashape, splat, pairs and 12 others (docs/programs.md)"
        );
    }
}
