//! `stereo/viewrank/run.sh`.

use crate::backends::ExportRecord;

/// `run.sh`: the commands of the record, from the workspace. A single rank can be computed where no map needs another.
pub fn runner(record: &ExportRecord, geometric: bool) -> String {
    let (fusion, maps) = record.commands.split_last().expect("the maps are fused");
    let compute = |c: &String| c.replacen("colmap patch_match_stereo --workspace_path . --config_path", "compute", 1);
    let single = |c: &String| compute(c).replacen("stereo/patch-match.cfg", "\"$list\"", 1);
    let rank = maps.first().filter(|_| !geometric).map(single);
    let rank = rank.map_or(NO_SINGLE_RANK.into(), |command| SINGLE_RANK.replace("@COMMAND@", &command));
    let mut script = format!("{RUNNER_HEAD}# {}\n{rank}{WHOLE_RUN}", record.way);
    maps.iter().for_each(|c| script += &format!("    {}\n", compute(c)));
    script + "fi\n" + &fusion.replacen("colmap", "\"${COLMAP:-colmap}\"", 1) + "\n"
}

const RUNNER_HEAD: &str = include_str!("../../../integrations/colmap/run_head.sh");
const SINGLE_RANK: &str = include_str!("../../../integrations/colmap/run_rank.sh");
const NO_SINGLE_RANK: &str = r#"if [ "${1:-}" = --rank ]; then
    echo "error: --rank: geometric depth maps need those of other views" >&2
    exit 2
fi
"#;
const WHOLE_RUN: &str = include_str!("../../../integrations/colmap/run_whole.sh");
