//! The dialects of MVSNet's files, each a backend.

use super::{
    super::{
        Backend, Capabilities, ExaminedProject, Honours, LastRun, PATCH_MATCH, PlanningNumbers,
        Trap,
    },
    run,
};
use crate::method::confidence::Photometric;

/// A dialect of the family.
pub(super) struct Dialect {
    pub backend: &'static Backend,
    pub made_for: &'static str,
    pub depths: DepthLine,
    /// True for ACMM and its relatives: they look partners up by position and fuse with the maps of
    /// all partners, so every image needs a map.
    pub all_are_problems: bool,
    /// True for readers of tuples: `tuples.txt`, a line for each key view.
    pub tuples: bool,
    /// Makes the depth maps of one size, if the program is known. With INPUT (folder of that size
    /// below the export), VIEWS (partners and key view), PARTNERS, WIDTH and HEIGHT (no image is
    /// smaller), SIZE (PatchmatchNet's option where images are reduced).
    pub depth: Option<&'static str>,
    /// Joins the maps of the list in `fuse/`, all of one size; `None` if the command above does.
    /// With AGREEING (partners that must agree), SIZE.
    pub fusion: Option<&'static str>,
}

/// Form of the last line of a camera file.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum DepthLine {
    /// Least, interval, number, greatest.
    Interval,
    /// Least, greatest.
    Range,
}

pub static PAIRS: Backend = Backend {
    name: "pairs",
    aliases: &["tuples", "mvsanywhere", "simplerecon"],
    program: "readers of pair.txt and of tuples",
    last_run: LastRun::Never("MVSAnywhere read at 798d25b; its variants are below"),
    capabilities: Capabilities {
        notes: "pair.txt with cameras, and tuples.txt; variants: mvsnet (MVSNet, CasMVSNet), patchmatchnet, acmm (ACMH, ACMM, ACMP, ACMMP)",
        ..CAPABILITIES
    },
    export: |selection, options| PAIRS_DIALECT.export(selection, options),
    ..MVSNET
};

const PAIRS_DIALECT: Dialect = Dialect {
    backend: &PAIRS,
    made_for: "readers of pair.txt with MVSNet's four-number depth line, and of tuples (MVSAnywhere 798d25b; read, not run)",
    depths: DepthLine::Interval,
    all_are_problems: false,
    tuples: true,
    depth: None,
    fusion: None,
};

pub static MVSNET: Backend = Backend {
    name: "mvsnet",
    aliases: &["casmvsnet"],
    program: "MVSNet, CasMVSNet",
    last_run: LastRun::Never("read at 3ae2cb2 and 2ae7da6; their readers of files run"),
    capabilities: Capabilities {
        notes: "takes the first view_num - 1 partners: call it with view_num = partners + 1; fusion needs pair_fuse.txt",
        ..CAPABILITIES
    },
    planning: PATCH_MATCH,
    traps,
    export: |selection, options| MVSNET_DIALECT.export(selection, options),
    ..Backend::DEFAULT
};

const MVSNET_DIALECT: Dialect = Dialect {
    backend: &MVSNET,
    made_for: "MVSNet, CasMVSNet and readers of their four-number depth line",
    tuples: false,
    depth: Some(
        "(here=$PWD && cd \"${MVSNET:?folder of its test.py}\" && python test.py --dense_folder \"$here\" --view_num VIEWS \
            --max_w WIDTH --max_h HEIGHT --interval_scale 1 --pretrained_model_ckpt_path \"${CHECKPOINT:?path of model.ckpt}\" \
            --ckpt_step \"${STEP:?its step}\")",
    ),
    ..PAIRS_DIALECT
};

pub static PATCHMATCHNET: Backend = Backend {
    name: "patchmatchnet",
    aliases: &["patchmatch"],
    program: "PatchmatchNet",
    last_run: LastRun::At {
        date: "2026-11-30",
        version: "974abc0 (CPU)",
        what: "maps and fusion",
    },
    capabilities: Capabilities {
        notes: "its filter opens the maps of all views in its list: viewrank run gives it those that are finished, all at one size",
        ..CAPABILITIES
    },
    planning: PlanningNumbers {
        photometric: Photometric {
            agree: 0.5,
            differ: 0.05,
            full_agreement: 0.9,
        },
        measured: "5 sets, in part",
        caution: Some(
            "By its maps of five sets, the cloud has 3 to 24 points less than these shares say.",
        ),
        source: "agreement: what its fusion keeps of 219 maps of 974abc0 (CPU) of boruszyn, lewis, statue and room; valley took no part and is foreseen \
                 better too; support 2: its fusion wants one other map that agrees; gate: the numbers of OpenMVS (method 7.1)",
        ..PATCH_MATCH
    },
    mixes_sizes: true,
    tasks: Some(run::TASKS),
    export: |selection, options| PATCHMATCHNET_DIALECT.export(selection, options),
    ..MVSNET
};

const PATCHMATCHNET_DIALECT: Dialect = Dialect {
    backend: &PATCHMATCHNET,
    made_for: "PatchmatchNet and readers of its two-number depth line",
    depths: DepthLine::Range,
    depth: Some(
        "(here=$PWD && cd \"${PATCHMATCHNET:?its folder}\" && \"${PYTHON:-python3}\" eval.py --input_folder \"$hereINPUT\" --output_folder \"$here/depths\" \
            --checkpoint_path \"${CHECKPOINT:-checkpoints/params_000007.ckpt}\" --num_views PARTNERSSIZE --output_type depth)",
    ),
    fusion: Some(
        "(here=$PWD && cd \"$PATCHMATCHNET\" && \"${PYTHON:-python3}\" eval.py --input_folder \"$here/fuse\" --output_folder \"$here/depths\" \
            --checkpoint_path \"${CHECKPOINT:-checkpoints/params_000007.ckpt}\" --output_type fusion --geo_mask_thres AGREEINGSIZE)",
    ),
    ..MVSNET_DIALECT
};

pub static ACMM: Backend = Backend {
    name: "acmm",
    aliases: &["acmh", "acmp", "acmmp"],
    program: "ACMH, ACMM, ACMP, ACMMP",
    last_run: LastRun::Never(
        "read at 7db8c1b, e7f34fa, 574c8e0 and 5b4c5fe; their reader of files run",
    ),
    capabilities: Capabilities {
        key_subset: Honours::No,
        order: Honours::Partly,
        fusion: "built in, over all views",
        notes: "makes maps of the partners too, with partners of their own, in several passes over all; fuse the key views' maps \
                elsewhere",
        ..CAPABILITIES
    },
    export: |selection, options| ACMM_DIALECT.export(selection, options),
    ..MVSNET
};

const ACMM_DIALECT: Dialect = Dialect {
    backend: &ACMM,
    made_for: "ACMH, ACMM, ACMP, ACMMP",
    all_are_problems: true,
    depth: Some("\"${ACMM:-ACMM}\" ."),
    ..MVSNET_DIALECT
};

const CAPABILITIES: Capabilities = Capabilities {
    partners: Honours::Yes,
    key_subset: Honours::Yes,
    order: Honours::Yes,
    fusion: "the reader's own filter, with pair_fuse.txt",
    notes: "",
};

fn traps(examined: &ExaminedProject) -> Vec<Trap> {
    examined
        .without_points("mvsnet-depth-range", "its depth line cannot be written")
        .into_iter()
        .collect()
}
