//! `stereo/viewrank/run.sh`.

use super::FUSED;
use crate::backends::{ExportRecord, strangers};

/// Returns `run.sh`: the commands of the record, run in the workspace. A single rank can be
/// computed if no map needs another.
///
/// `half_size`: long side of the images of key views in `half.txt`.
pub fn runner(record: &ExportRecord, geometric: bool, half_size: Option<u32>) -> String {
    let (fusion, maps) = record.commands.split_last().expect("the maps are fused");
    let compute = |c: &String| {
        c.replacen(
            "colmap patch_match_stereo --workspace_path . --config_path",
            "compute",
            1,
        )
    };
    // The command for any list, here for that of a single rank.
    let single = |c: &String| {
        let words = compute(c);
        let (_, options) = words
            .trim_start_matches("compute ")
            .split_once(' ')
            .unwrap_or_default();
        format!("compute \"$list\" {options}")
    };
    let is_half =
        |c: &&String| half_size.is_some_and(|size| c.ends_with(&format!("max_image_size {size}")));
    let of_half = maps.iter().find(is_half).map(single);
    let of_full = maps.iter().find(|c| !is_half(c)).map(single);
    let command = match (of_full, of_half) {
        (Some(full), Some(half)) => {
            format!(
                "if grep -qxF -- \"$KEY\" stereo/viewrank/half.txt; then\n        {half}\n    else\n        {full}\n    fi"
            )
        }
        (full, half) => full.or(half).unwrap_or_default(),
    };
    let rank = if geometric {
        NO_SINGLE_RANK.into()
    } else {
        SINGLE_RANK.replace("@COMMAND@", &command)
    };
    let mut script = format!("{RUNNER_HEAD}# {}\n{rank}{WHOLE_RUN}", record.way);
    maps.iter()
        .for_each(|c| script += &format!("    {}\n", compute(c)));
    let fusion = fusion.replacen("colmap", "\"${COLMAP:-colmap}\"", 1);
    // A new file: an older one may have another name elsewhere.
    script += &format!(
        "fi\nrm -f {UNFINISHED} {UNFINISHED}.vis\n{}\n",
        fusion.replace(FUSED, UNFINISHED)
    );
    script += &format!(
        "[ ! -f {UNFINISHED}.vis ] || mv {UNFINISHED}.vis {FUSED}.vis\nmv {UNFINISHED} {FUSED}\n"
    );
    strangers::with_refusal(&script)
}

const UNFINISHED: &str = "stereo/viewrank/unfinished.ply";
const RUNNER_HEAD: &str = include_str!("../../../integrations/colmap/run_head.sh");
const SINGLE_RANK: &str = include_str!("../../../integrations/colmap/run_rank.sh");
const NO_SINGLE_RANK: &str = r#"if [ "${1:-}" = --rank ]; then
    echo "error: --rank: geometric depth maps need those of other views" >&2
    exit 2
fi
"#;
const WHOLE_RUN: &str = include_str!("../../../integrations/colmap/run_whole.sh");
