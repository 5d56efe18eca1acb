//! Shell functions that all exported scripts share: a script restarts itself under a fixed name,
//! and refuses links, pipes and the like that somebody else has put into its folder.

use super::ExportRecord;
use crate::io::output::{Contents, FileSet};

/// The function of sh that refuses.
const REFUSE: &str = include_str!("../../integrations/refuse_strangers.sh");

/// The lines of sh with which a `run.sh` starts itself again.
const RESTART: &str = include_str!("../../integrations/restart.sh");

/// The lines of sh that leave only absolute folders in the PATH.
const ABSOLUTE_PATH: &str = include_str!("../../integrations/absolute_path.sh");

/// Returns a script with the function, and the restart and the clean PATH if it has them, in the
/// places of their lines.
pub fn with_refusal(script: &str) -> String {
    script
        .replacen("@RESTART@\n", RESTART, 1)
        .replacen("@ABSOLUTE_PATH@\n", ABSOLUTE_PATH, 1)
        .replacen("@REFUSE_STRANGERS@\n", REFUSE, 1)
}

/// Adds `run.sh`, which runs the commands of an export one after the other; the export's files are
/// complete but for its record.
pub fn add_runner(files: &mut FileSet, record: &mut ExportRecord) {
    let head = with_refusal(include_str!("../../integrations/run_commands.sh"));
    record.runner = Some("run.sh".into());
    files.add_script("run.sh", head + &record.commands.join("\n") + "\n");
    name_links_in_scripts(files);
}

/// Puts the links of an export, as `find .` names them, where its script has the line `@LINKS@`:
/// any other is refused. In a list of their own somebody could add to them.
pub fn name_links_in_scripts(files: &mut FileSet) {
    let is_link = |(path, contents): (&String, &Contents)| {
        // With a line break it would be two lines, of which one may name somebody else's link.
        let is_named =
            matches!(contents, Contents::Link { .. }) && !path.contains(char::is_control);
        is_named.then(|| path.clone())
    };
    let links: Vec<String> = files.files.iter().filter_map(is_link).collect();
    for contents in files.files.values_mut() {
        if let Contents::Script(script) = contents
            && let Some(with_links) = with_links(&String::from_utf8_lossy(script), &links)
        {
            *script = with_links.into_bytes();
        }
    }
}

/// `None` for a script without the line. In Python it is a comment, as each link then is.
fn with_links(script: &str, links: &[String]) -> Option<String> {
    let (before, after) = script.split_once("@LINKS@\n")?;
    let (before, prefix) = before.split_at(before.rfind('\n')? + 1);
    let links = links.iter().map(|link| format!("{prefix}./{link}\n"));
    Some(before.to_owned() + &links.collect::<String>() + after)
}
