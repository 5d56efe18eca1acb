//! `viewrank doctor`: finds problems of a project.

use std::path::PathBuf;

use crate::{
    apps::doctor::{self, Diagnosis, Finding, NO_TRACKS, Severity, ViewFinding},
    backends::Backend,
    config::CommandLineSettings,
    io::project::Project,
    show::manifest::planned_options,
};
use clap::Args;

use super::{Exit, Failure, Format, config, print, print_json, wrapped};

/// Number of views listed by name; further ones are only counted.
const LISTED: usize = 6;
/// Number of other programs up to which they are named.
const NAMED: usize = 3;

/// Find problems of a project: views without partners and why, weak links, impossible units, traps
/// of MVS programs.
///
/// Needs no plan. Exit code 0: no findings, or only notes; 3: warnings; 4: errors. Views without
/// partners (at the border of a block, say) are a note if other views see their area, a warning
/// from 1 % of the sparse points lost or 10 % of the views, an error from 50 % of either.
#[derive(Args)]
pub struct Arguments {
    /// Folder of the project, or its model
    #[arg(value_parser = super::arguments::project())]
    project: PathBuf,

    /// Backends to check; partners are checked for the first [default: all; partners for the
    /// planned one, else the one set up]
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    backend: Vec<String>,
    /// Sub-model to check [default: the one with most images]
    #[arg(long, value_name = "N")]
    model: Option<String>,
    /// Part of the scene to check for missed ground, as plan takes it [default: that of the
    /// settings or of the plan]
    #[arg(
        long,
        value_name = "FILE|X0,Y0,Z0,X1,Y1,Z1|auto",
        allow_hyphen_values = true
    )]
    region: Option<String>,
    /// Wanted ground sampling distance, as plan takes it: ground that photographs show in larger
    /// pixels than four times it counts as missed [default: that of the settings or of the plan]
    #[arg(long, value_name = "L")]
    gsd: Option<String>,
    /// List every view, not only the first few
    #[arg(long)]
    all: bool,
    /// Format of the results on stdout
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let project = Project::open_or_planned(&arguments.project, arguments.model.as_deref())?;
    let mut typed = CommandLineSettings::default();
    let region = arguments.region.as_deref();
    typed.set("--region", "region", region.map(super::arguments::region));
    typed.set("--gsd", "target.gsd", arguments.gsd.clone());
    let mut settings = config::load(Some(&project), typed)?.settings;
    if settings.target.gsd.is_some() && settings.region.is_none() {
        let planned = planned_options(&project.home);
        let region = planned.iter().find(|option| option.key == "region");
        config::refuse_outside(region.as_slice(), &project.root)?;
        settings.region = region.and_then(|option| option.value.as_str()?.parse().ok());
    }
    let project = project.with_images(settings.images.as_deref());
    let wanted = if arguments.backend.is_empty() {
        &settings.backends
    } else {
        &arguments.backend
    };
    let backends = doctor::backends_to_check(&project, wanted, arguments.backend.is_empty())?;
    let scene = project.read_scene()?;
    let diagnosis = doctor::examine(&project, &scene, &settings, &backends);
    match arguments.format {
        Format::Json => print_json(&diagnosis)?,
        Format::Text => {
            let mut lines = text(
                &diagnosis.findings,
                if arguments.all { usize::MAX } else { LISTED },
            );
            lines.extend(checked(&diagnosis, &backends));
            print(lines)?;
        }
    }
    verdict(&diagnosis.findings)
}

/// Returns the exit code of the worst finding.
fn verdict(findings: &[Finding]) -> Result<(), Failure> {
    let count = |severity| {
        findings
            .iter()
            .filter(|finding| finding.severity == severity)
            .count()
    };
    let (errors, warnings) = (count(Severity::Error), count(Severity::Warning));
    let exit = match (errors, warnings) {
        (0, 0) => return Ok(()),
        (0, _) => Exit::Warnings,
        _ => Exit::Errors,
    };
    Err(Failure::already_printed(exit))
}

fn text(findings: &[Finding], listed: usize) -> Vec<String> {
    if findings.is_empty() {
        return vec!["Nothing is wrong with this project.".into()];
    }
    let mut lines = Vec::new();
    for finding in findings {
        let severity = match finding.severity {
            Severity::Error => "ERROR  ",
            Severity::Warning => "warning",
            Severity::Note => "note   ",
        };
        lines.extend(wrapped(&format!("{severity} "), &finding.what));
        if !finding.backends.is_empty() {
            let programs = match &finding.backends[..] {
                [first, others @ ..] if others.len() > NAMED && listed == LISTED => {
                    format!("{first} and {} other programs", others.len())
                }
                all => all.join(", "),
            };
            lines.extend(wrapped("        for     ", &programs));
        }
        lines.extend(wrapped("        do      ", &finding.cure));
        // Of programs that the project is not planned for, only with --all.
        let is_of_others =
            finding.severity == Severity::Note && !finding.backends.is_empty() && listed == LISTED;
        let listed = if is_of_others { 0 } else { listed };
        for ViewFinding { name, why } in finding.views.iter().take(listed) {
            let why = if why.is_empty() {
                String::new()
            } else {
                format!(": {why}")
            };
            lines.extend(wrapped("          - ", &format!("{name}{why}")));
        }
        if finding.views.len() > listed {
            let more = match listed {
                0 => doctor::counted(finding.views.len(), "view"),
                _ => format!("and {} more", finding.views.len() - listed),
            };
            lines.push(format!("          {more} (--all names them)"));
        }
        lines.push(String::new());
    }
    lines.push(counts(findings));
    lines
}

/// Says what was checked.
fn checked(diagnosis: &Diagnosis, backends: &[&Backend]) -> Vec<String> {
    let own = diagnosis.backend;
    let others: Vec<&str> = backends
        .iter()
        .map(|backend| backend.name)
        .filter(|name| *name != own)
        .collect();
    let others = match &others[..] {
        [] => String::new(),
        few if few.len() <= NAMED => format!("; traps of {}", few.join(", ")),
        many => format!("; traps of {} other programs", many.len()),
    };
    let has_tracks = diagnosis.findings.iter().all(|f| f.check != NO_TRACKS);
    let links = match (diagnosis.partners_judged, has_tracks) {
        (true, true) => " partners of each view, weak links,",
        (true, false) => " partners of each view,",
        (false, _) => "",
    };
    let what = format!(
        "cameras, poses and points of the model, its units,{links} image files and their sizes, masks, traps of {own}, which the project would be \
         planned for{others}."
    );
    wrapped("Checked: ", &what)
}

/// Counts findings by severity, on one line.
fn counts(findings: &[Finding]) -> String {
    let kinds = [
        (Severity::Error, "error"),
        (Severity::Warning, "warning"),
        (Severity::Note, "note"),
    ];
    let count = |(severity, name): (Severity, &str)| {
        let n = findings
            .iter()
            .filter(|finding| finding.severity == severity)
            .count();
        (n > 0).then(|| format!("{n} {name}{}", if n == 1 { "" } else { "s" }))
    };
    kinds
        .into_iter()
        .filter_map(count)
        .collect::<Vec<_>>()
        .join(", ")
        + "."
}
