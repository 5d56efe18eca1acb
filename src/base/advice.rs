//! Advice as the command line says it: settings as options.

use viewrank_core::base::error::Advice;

/// Settings whose option has not the name of their key.
const OPTIONS: [(&str, &str); 11] = [
    ("target.gsd", "--gsd"),
    ("surface.mesh", "--mesh"),
    ("pilot.maps", "--pilot"),
    ("confidence.source", "--confidence"),
    ("max_memory", "--max-memory"),
    ("backends", "--backend"),
    ("partners.k", "-k"),
    ("cut.target", "--target"),
    ("cut.budget", "--budget"),
    ("cut.time", "--time"),
    ("test_every", "--test-every"),
];

/// Writes settings as options of the program.
pub fn on_command_line(advice: &Advice) -> String {
    advice.describe(|key, value| {
        let known = OPTIONS.iter().find(|(known, _)| *known == key);
        let option = known.map_or_else(|| format!("--{key}"), |(_, option)| (*option).into());
        match value {
            None => option,
            Some(value) => format!("{option} {value}"),
        }
    })
}
