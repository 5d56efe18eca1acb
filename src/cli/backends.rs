//! `viewrank backends`: what each MVS program honours of a plan, and what it contributes to planning.

use clap::Args;
use serde::Serialize;
use viewrank::backends::{self, Backend, Capabilities, Honours, PlanningNumbers};

use super::{Failure, Format, json, print};

/// List the MVS programs that plans are written for: what each honours and what it contributes to planning.
#[derive(Args)]
pub struct Arguments {
    /// Only this one, with its notes
    name: Option<String>,
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

#[derive(Serialize)]
struct Entry {
    name: &'static str,
    capabilities: Capabilities,
    planning: PlanningNumbers,
    options: &'static [&'static str],
}

impl Entry {
    fn new(backend: &dyn Backend) -> Self {
        Self {
            name: backend.name(),
            capabilities: backend.capabilities(),
            planning: backend.planning(),
            options: backend.options(),
        }
    }
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let entries: Vec<Entry> = match &arguments.name {
        Some(name) => vec![Entry::new(backends::by_name(name).map_err(Failure::usage)?)],
        None => backends::all().iter().map(|b| Entry::new(*b)).collect(),
    };
    match (arguments.format, &arguments.name) {
        (Format::Json, _) => print(&json(&entries)),
        (Format::Text, None) => print(&table(&entries)),
        (Format::Text, Some(_)) => print(&entries.iter().map(details).collect::<String>()),
    }
}

fn word(honours: Honours) -> &'static str {
    match honours {
        Honours::Yes => "yes",
        Honours::Partly => "partly",
        Honours::No => "no",
    }
}

fn table(entries: &[Entry]) -> String {
    let mut text = format!("{:<14}{:<10}{:<10}{:<8}{}\n", "name", "partners", "only keys", "order", "fusion");
    for entry in entries {
        let c = &entry.capabilities;
        text += &format!(
            "{:<14}{:<10}{:<10}{:<8}{}\n",
            entry.name,
            word(c.partners),
            word(c.key_subset),
            word(c.order),
            c.fusion
        );
    }
    text + "\nviewrank backends NAME says what is not honoured, which pairs can be matched, and where the numbers come from.\n"
}

fn details(entry: &Entry) -> String {
    let (c, p) = (&entry.capabilities, &entry.planning);
    let number = |value: Option<f64>, unit: &str| value.map_or("none".into(), |v| format!("{v}{unit}"));
    let mut text = format!(
        "{}\n  exactly the given partners   {}\n  only the key views           {}\n  rank order                   {}\n  fusion                       {}\n  \
         notes                        {}\n",
        entry.name,
        word(c.partners),
        word(c.key_subset),
        word(c.order),
        c.fusion,
        c.notes
    );
    let scale = if p.gate.max_scale_octaves.is_finite() {
        format!(", scale ratio up to {:.2}", p.gate.max_scale_octaves.exp2())
    } else {
        String::new()
    };
    let epipole = if p.gate.epipole_inside { "" } else { ", epipole outside of both images" };
    text += &format!(
        "  pairs that can be matched    at least {} shared points, {} to {} degrees{scale}{epipole}\n",
        p.gate.min_shared_points, p.gate.min_angle_deg, p.gate.max_angle_deg
    );
    text += &format!(
        "  geometric confidence         min_matches {}, p0 {}, cosine_power {}, scale_octaves {}, full_angle {}\n  support                      {} depth maps\n  \
         source                       {}\n",
        p.confidence.min_matches,
        p.confidence.p0,
        p.confidence.cosine_power,
        number(p.confidence.scale_octaves, ""),
        number(p.confidence.full_angle_deg, " degrees"),
        p.support,
        p.source
    );
    if !entry.options.is_empty() {
        text += &format!("  options of export            {}\n", entry.options.join(", "));
    }
    text
}
