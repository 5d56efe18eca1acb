//! `viewrank backends`: capabilities and planning numbers of each MVS program.

use crate::{
    apps::doctor::counted,
    backends::{self, Backend, Capabilities, Honours},
    method::confidence::{PairConfidence, Photometric},
    model::cluster::Gate,
    plan::{PlanningNumbers, WorkPerMap},
};
use clap::Args;
use serde::Serialize;

use super::{Failure, Format, print, print_json, wrapped};

/// List the supported MVS programs, what each honours and its planning numbers.
#[derive(Args)]
pub struct Arguments {
    /// Show only this program, with its notes
    name: Option<String>,
    /// Format of the list on stdout
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

#[derive(Serialize)]
struct Entry {
    name: &'static str,
    program: &'static str,
    capabilities: Capabilities,
    planning: PlanningNumbers,
    options: &'static [&'static str],
    /// Sizes of depth maps that it can mix, over that of the plan (`ranking.scales`).
    scales: &'static [f64],
    /// Newest version that was run on what viewrank writes, and when; or that none was.
    run_here: String,
    #[serde(skip)]
    matches: bool,
}

impl Entry {
    fn new(backend: &Backend) -> Self {
        Self {
            name: backend.name,
            program: backend.program,
            capabilities: backend.capabilities,
            planning: backend.planning,
            options: backend.options,
            scales: if backend.mixes_sizes {
                &[1.0, 0.5]
            } else {
                &[1.0]
            },
            run_here: backend.last_run.describe(),
            matches: backend.makes_maps(),
        }
    }
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let entries: Vec<Entry> = match &arguments.name {
        Some(name) => vec![Entry::new(backends::by_name(name)?)],
        None => backends::BACKENDS.iter().map(|b| Entry::new(b)).collect(),
    };
    match (arguments.format, &arguments.name) {
        (Format::Json, _) => print_json(&entries),
        (Format::Text, None) => print(table(&entries)),
        (Format::Text, Some(_)) => print(entries.iter().flat_map(details)),
    }
}

/// Help of an option that takes names of backends.
pub fn option_help(what: &str, default: &str) -> String {
    format!("{what}: {} [default: {default}]", backends::names())
}

fn word(honours: Honours) -> &'static str {
    match honours {
        Honours::Yes => "yes",
        Honours::Partly => "partly",
        Honours::No => "no",
    }
}

/// At most 80 columns.
fn table(entries: &[Entry]) -> Vec<String> {
    let head = [
        "name",
        "partners",
        "only keys",
        "order",
        "angles",
        "scale",
        "maps",
        "measured on",
    ];
    let mut lines = vec![row(head.map(String::from))];
    for entry in entries {
        let (c, p) = (&entry.capabilities, &entry.planning);
        lines.push(row([
            entry.name.into(),
            word(c.partners).into(),
            word(c.key_subset).into(),
            word(c.order).into(),
            format!("{}-{}", p.gate.min_angle_deg, p.gate.max_angle_deg),
            if p.gate.max_scale_octaves.is_finite() {
                format!("{:.1}", p.gate.max_scale_octaves.exp2())
            } else {
                "any".into()
            },
            p.support.to_string(),
            p.measured.into(),
        ]));
    }
    lines.extend(TABLE_NOTES.lines().map(String::from));
    lines
}

const TABLE_NOTES: &str = "
partners   exactly the given partners are matched
only keys  depth maps are made of the key views only
order      in rank order
angles     degrees between the views of a pair that can be matched
scale      largest ratio of their scales
maps       depth maps that must see a place, since fusion compares them

viewrank backends NAME says what is not honoured, how depth maps are joined, and
where each number comes from.
";

fn row(cells: [String; 8]) -> String {
    let [name, partners, keys, order, angles, scale, maps, measured] = cells;
    format!("{name:<15}{partners:<10}{keys:<11}{order:<8}{angles:<8}{scale:<7}{maps:<6}{measured}")
}

fn details(entry: &Entry) -> Vec<String> {
    let (c, p) = (&entry.capabilities, &entry.planning);
    let mut lines = vec![entry.name.to_owned()];
    let mut add = |what: &str, value: &str| lines.extend(labelled(what, value));
    add("exactly the given partners", word(c.partners));
    add("only the key views", word(c.key_subset));
    add("rank order", word(c.order));
    if entry.matches {
        let scales = match entry.scales {
            [_] => "1",
            _ => "1 and 0.5 (viewrank plan --scales)",
        };
        add("scales of depth maps", scales);
    }
    add("program", entry.program);
    add("run here", &entry.run_here);
    add("fusion", c.fusion);
    add("notes", c.notes);
    add("pairs that can be matched", &pairs(&p.gate));
    add("geometric confidence", &confidence(&p.confidence));
    let Photometric {
        agree,
        differ,
        full_agreement,
    } = p.photometric;
    let photometric = format!("agree {agree}, differ {differ}, full_agreement {full_agreement}");
    add("photometric", &photometric);
    if entry.matches {
        let WorkPerMap { fixed, per_map } = p.work;
        let work = format!("{fixed} + Mpx ({per_map} + partners), in Mpx matched with one partner");
        add("work of a depth map", &work);
    }
    let supports = if entry.matches { "depth map" } else { "image" };
    add("support", &counted(p.support as usize, supports));
    add("source", p.source);
    if !entry.options.is_empty() {
        add("options of export", &entry.options.join(", "));
    }
    lines
}

fn pairs(gate: &Gate) -> String {
    let scale = match gate.max_scale_octaves {
        octaves if octaves.is_finite() => format!(", scale ratio up to {:.2}", octaves.exp2()),
        _ => String::new(),
    };
    let epipole = if gate.epipole_inside {
        ""
    } else {
        ", epipole outside of both images"
    };
    format!(
        "at least {} shared points, {} to {} degrees{scale}{epipole}",
        gate.min_shared_points, gate.min_angle_deg, gate.max_angle_deg
    )
}

fn confidence(of_pairs: &PairConfidence) -> String {
    let number =
        |value: Option<f64>, unit: &str| value.map_or("none".into(), |v| format!("{v}{unit}"));
    format!(
        "min_matches {}, p0 {}, cosine_power {}, scale_octaves {}, full_angle {}",
        of_pairs.min_matches,
        of_pairs.p0,
        of_pairs.cosine_power,
        number(of_pairs.scale_octaves, ""),
        number(of_pairs.full_angle_deg, " degrees"),
    )
}

/// Formats a value, wrapped and indented under its start.
fn labelled(what: &str, value: &str) -> Vec<String> {
    wrapped(&format!("  {what:<28}"), value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn everything_fits_into_80_columns() {
        let entries: Vec<Entry> = backends::BACKENDS.iter().map(|b| Entry::new(b)).collect();
        let long = |lines: &[String]| lines.iter().find(|line| line.chars().count() > 80).cloned();
        assert_eq!(long(&table(&entries)), None);
        assert_eq!(entries.iter().find_map(|entry| long(&details(entry))), None);
    }

    #[test]
    fn the_documentation_names_the_backends_that_mix_sizes() {
        let numbers = include_str!("../../docs/numbers.md");
        let (_, list) = numbers
            .split_once("With `--scales 1,0.5` (backends ")
            .expect("the list");
        let (list, _) = list.split_once(')').expect("its end");
        let named: Vec<&str> = list.split('`').skip(1).step_by(2).collect();
        let mut expected: Vec<&str> = backends::BACKENDS
            .iter()
            .filter(|b| b.mixes_sizes)
            .map(|b| b.name)
            .collect();
        expected.sort_by_key(|name| named.iter().position(|n| n == name));
        assert_eq!(named, expected);
    }

    #[test]
    fn wrapping_loses_no_word() {
        let value = "one two ".repeat(40);
        let words: Vec<String> = labelled("what", &value)
            .join("\n")
            .split_whitespace()
            .map(String::from)
            .collect();
        assert_eq!(words.len(), 81);
    }
}
