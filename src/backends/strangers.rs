//! Shell functions that all exported scripts share: a script restarts itself under a fixed name, and
//! refuses links, pipes and the like that somebody else has put into its folder.

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

/// Adds `run.sh`, which runs the commands of an export one after the other, and `links.txt`; the
/// export's files are complete but for its record.
pub fn add_runner(files: &mut FileSet, record: &mut ExportRecord) {
    let head = with_refusal(include_str!("../../integrations/run_commands.sh"));
    record.runner = Some("run.sh".into());
    files.add_script("run.sh", head + &record.commands.join("\n") + "\n");
    list_links(files);
}

/// Adds `links.txt`, the links of an export, as `find .` names them: any other is refused.
pub fn list_links(files: &mut FileSet) {
    let is_link = |(path, contents): (&String, &Contents)| {
        // With a line break it would be two lines, of which one may name somebody else's link.
        let is_named =
            matches!(contents, Contents::Link { .. }) && !path.contains(char::is_control);
        is_named.then(|| format!("./{path}\n"))
    };
    let links: String = files.files.iter().filter_map(is_link).collect();
    files.add_text("links.txt", links);
}
