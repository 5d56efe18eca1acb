//! `viewrank doctor`: what is wrong with a project, in the terminal.

use std::{fmt::Write, path::PathBuf};

use clap::Args;
use viewrank::{
    backends::{self, Backend, BackendError},
    doctor::{self, Finding, Severity, ViewFinding},
    manifest::planned_backend,
    project::Project,
};

use super::{Exit, Failure, Format, config, json, print};

/// Width of the printed page.
const COLUMNS: usize = 80;
/// Views that are named before the rest is only counted.
const LISTED: usize = 6;

/// Say what is wrong with a project: views without partners and why, weak links, impossible units, traps of MVS programs.
///
/// Needs no plan. Exit code 0: nothing, or only notes; 3: warnings; 4: errors. Views without partners, as at the border of a block, are a
/// note while others see their places, a warning from 1 % of the sparse points lost or a tenth of the views, an error from half of either.
#[derive(Args)]
pub struct Arguments {
    project: PathBuf,

    /// Programs to look at; partners are judged for the first [default: all, partners for the one that the project is set up for]
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    backend: Vec<String>,
    /// Sub-model to look at [default: the one with most images]
    #[arg(long, value_name = "N")]
    model: Option<String>,
    /// Name every view, not only the first few
    #[arg(long)]
    all: bool,
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let project = Project::open(&arguments.project, arguments.model.as_deref())?;
    let settings = config::load(Some(&project.root), Default::default())?.settings;
    let wanted = if arguments.backend.is_empty() { &settings.backends } else { &arguments.backend };
    let backends = backends_to_visit(&project, wanted, arguments.backend.is_empty())?;
    let scene = project.read_scene()?;
    let diagnosis = doctor::examine(&project, &scene, &settings, &backends);
    match arguments.format {
        Format::Json => print(&json(&diagnosis))?,
        Format::Text => print(&text(&diagnosis.findings, if arguments.all { usize::MAX } else { LISTED }))?,
    }
    verdict(&diagnosis.findings)
}

/// Those that are named, else that of the plan that is there, first; and all others, where none was typed.
fn backends_to_visit(
    project: &Project,
    wanted: &[String],
    others: bool,
) -> Result<Vec<&'static dyn Backend>, BackendError> {
    let mut visited = backends::by_names(wanted)?;
    if visited.is_empty() {
        let planned = planned_backend(project).and_then(|name| backends::by_name(&name).ok());
        visited.push(planned.unwrap_or_else(|| backends::for_project(project)));
    }
    let rest = backends::all().iter().copied().filter(|_| others);
    for backend in rest {
        if visited.iter().all(|v: &&dyn Backend| v.name() != backend.name()) {
            visited.push(backend);
        }
    }
    Ok(visited)
}

/// The exit code by the worst finding.
fn verdict(findings: &[Finding]) -> Result<(), Failure> {
    let count = |severity| findings.iter().filter(|finding| finding.severity == severity).count();
    let (errors, warnings) = (count(Severity::Error), count(Severity::Warning));
    let exit = match (errors, warnings) {
        (0, 0) => return Ok(()),
        (0, _) => Exit::Warnings,
        _ => Exit::Errors,
    };
    Err(Failure { exit, message: format!("errors: {errors}, warnings: {warnings}"), hint: None })
}

fn text(findings: &[Finding], listed: usize) -> String {
    if findings.is_empty() {
        return "Nothing is wrong with this project.\n".into();
    }
    let mut text = String::new();
    for finding in findings {
        let severity = match finding.severity {
            Severity::Error => "ERROR  ",
            Severity::Warning => "warning",
            Severity::Note => "note   ",
        };
        text += &wrapped(&format!("{severity} "), &finding.what);
        if !finding.backends.is_empty() {
            text += &wrapped("        for     ", &finding.backends.join(", "));
        }
        text += &wrapped("        do      ", &finding.cure);
        for ViewFinding { name, why } in finding.views.iter().take(listed) {
            let why = if why.is_empty() { String::new() } else { format!(": {why}") };
            text += &wrapped("          - ", &format!("{name}{why}"));
        }
        if finding.views.len() > listed {
            let _ = writeln!(text, "          and {} more (--all names them)", finding.views.len() - listed);
        }
        text.push('\n');
    }
    text
}

/// The words behind a heading, broken at the width of the page; a word that is longer stays whole, so that it can be copied.
fn wrapped(heading: &str, words: &str) -> String {
    let indent = " ".repeat(heading.len());
    let (mut text, mut line) = (String::new(), heading.to_owned());
    let mut empty = true;
    for word in words.split(' ') {
        if !empty && line.chars().count() + 1 + word.chars().count() > COLUMNS {
            text += &line;
            text.push('\n');
            line.clone_from(&indent);
            empty = true;
        }
        if !empty {
            line.push(' ');
        }
        line += word;
        empty = false;
    }
    text + &line + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_end_at_the_width_of_the_page() {
        let text = wrapped("warning ", &"word ".repeat(60));
        assert!(text.lines().all(|line| line.chars().count() <= COLUMNS) && text.lines().count() > 3);
        assert_eq!(wrapped("- ", "one"), "- one\n");
        let long = "x".repeat(100);
        assert_eq!(wrapped("- ", &long), format!("- {long}\n"), "what is to be copied stays whole");
    }
}
