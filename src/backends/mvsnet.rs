//! MVSNet and the programs that read its files: `docs/backends.md` 3 and 14. `pair.txt` lists the key views with their partners, `cams/` contains the cameras;
//! the readers differ in the depth line of a camera and in which views they expect.

use super::{
    Backend, BackendError, Capabilities, ExaminedProject, Export, ExportOptions, ExportRecord, Honours, PATCH_MATCH,
    PlanningNumbers, Selection, Trap, selection,
};
use crate::{
    io::output::Contents,
    method::confidence::Photometric,
    model::{
        camera::Camera,
        cluster::RankedCluster,
        scene::{ViewIndex, ViewPoints},
    },
};

/// A dialect of the family.
struct Dialect {
    backend: &'static Backend,
    made_for: &'static str,
    depths: DepthLine,
    /// True for ACMM and its relatives: they look partners up by position and fuse with the maps of all partners, so every image needs a map.
    all_are_problems: bool,
    /// With VIEWS (partners and key view), PARTNERS, WIDTH and HEIGHT (no image is smaller), AGREEING (partners that must agree), SIZE (PatchmatchNet's
    /// option where images are reduced).
    commands: &'static [&'static str],
    /// Names and contents of the scripts that the commands call.
    scripts: &'static [(&'static str, &'static str)],
}

/// Form of the last line of a camera file.
#[derive(Clone, Copy, PartialEq, Eq)]
enum DepthLine {
    /// Least, interval, number, greatest.
    Interval,
    /// Least, greatest.
    Range,
}

/// Number of planes between the least and the greatest depth.
const PLANES: u32 = 192;
/// Number of partners that must agree on a depth: one less than the plan's support, which includes the key view.
const AGREEING: u32 = PATCH_MATCH.support - 1;
/// Largest number of key views whose maps the fusion compares with one: its own lists hold every view that shares points, which takes long.
const FUSED_WITH: usize = 24;
/// Largest number of partners of ACMH, ACMM, ACMP and ACMMP, which use a 32-bit mask.
const ACM_PARTNERS: usize = 32;

pub static MVSNET: Backend = Backend {
    name: "mvsnet",
    aliases: &["casmvsnet"],
    capabilities: Capabilities {
        notes: "takes the first view_num - 1 partners: call it with view_num = partners + 1; fusion needs pair_fuse.txt",
        ..CAPABILITIES
    },
    planning: PATCH_MATCH,
    options: &[],
    use_of_views: None,
    own_scale: super::full_size,
    takes_distorted: false,
    mixes_sizes: false,
    serves: |_| false,
    tasks: |_, _| None,
    traps,
    export: |selection, options| MVSNET_DIALECT.export(selection, options),
};

const MVSNET_DIALECT: Dialect = Dialect {
    backend: &MVSNET,
    made_for: "MVSNet, CasMVSNet and readers of their four-number depth line",
    depths: DepthLine::Interval,
    all_are_problems: false,
    commands: &[
        "(here=$PWD && cd \"${MVSNET:?folder of its test.py}\" && python test.py --dense_folder \"$here\" --view_num VIEWS \
                 --max_w WIDTH --max_h HEIGHT --interval_scale 1 --pretrained_model_ckpt_path \"${CHECKPOINT:?path of model.ckpt}\" \
                 --ckpt_step \"${STEP:?its step}\")",
    ],
    scripts: &[],
};

pub static PATCHMATCHNET: Backend = Backend {
    name: "patchmatchnet",
    aliases: &["patchmatch"],
    capabilities: Capabilities {
        notes: "its own filter opens the maps of all partners: swap in pair_fuse.txt for it",
        ..CAPABILITIES
    },
    planning: PlanningNumbers {
        photometric: Photometric { agree: 0.5, differ: 0.05, full_agreement: 0.9 },
        measured: "5 sets, in part",
        source: "agreement: what its fusion keeps of 219 maps of 974abc0 (CPU) of boruszyn, lewis, statue and room; valley took no part and is foreseen \
                 better too (method 7.4); support 2: its fusion wants one other map that agrees; gate: the numbers of OpenMVS (method 7.1)",
        ..PATCH_MATCH
    },
    export: |selection, options| PATCHMATCHNET_DIALECT.export(selection, options),
    ..MVSNET
};

const PATCHMATCHNET_DIALECT: Dialect = Dialect {
    backend: &PATCHMATCHNET,
    made_for: "PatchmatchNet and readers of its two-number depth line",
    depths: DepthLine::Range,
    all_are_problems: false,
    commands: &[
        "(here=$PWD && cd \"${PATCHMATCHNET:?its folder}\" && python eval.py --input_folder \"$here\" --output_folder \"$here/depths\" \
         --checkpoint_path \"${CHECKPOINT:-checkpoints/params_000007.ckpt}\" --num_views PARTNERSSIZE --output_type depth)",
        "python3 finished.py",
        "(here=$PWD && cd \"$PATCHMATCHNET\" && python eval.py --input_folder \"$here/fuse\" --output_folder \"$here/depths\" \
         --checkpoint_path \"${CHECKPOINT:-checkpoints/params_000007.ckpt}\" --output_type fusion --geo_mask_thres AGREEINGSIZE)",
    ],
    scripts: &[("finished.py", include_str!("../../integrations/mvsnet/finished.py"))],
};

pub static ACMM: Backend = Backend {
    name: "acmm",
    aliases: &["acmh", "acmp", "acmmp"],
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
    depths: DepthLine::Interval,
    all_are_problems: true,
    commands: &["\"${ACMM:-ACMM}\" ."],
    scripts: &[],
};

const CAPABILITIES: Capabilities = Capabilities {
    partners: Honours::Yes,
    key_subset: Honours::Yes,
    order: Honours::Yes,
    fusion: "the reader's own filter, with pair_fuse.txt",
    notes: "",
};

fn traps(patient: &ExaminedProject) -> Vec<Trap> {
    patient.without_points("mvsnet-depth-range", "its depth line cannot be written").into_iter().collect()
}

impl Dialect {
    fn export(&self, selection: &Selection, options: &ExportOptions) -> Result<Export, BackendError> {
        let near = selection.near_origin();
        let selection = &near.selection();
        let images = selection.undistorted_images(self.backend.name)?;
        let views = selection.keys_first();
        let lists = Lists::new(self, selection, &views);
        let mut files = options.file_set(self.backend, selection);
        files.add_text("pair.txt", lists.text(&lists.rows));
        files.add_text("pair_fuse.txt", lists.text(&lists.compared));
        let mut names = String::new();
        for (&i, &view) in lists.numbers.iter().zip(&views) {
            files.add_text(format!("cams/{i:08}_cam.txt"), self.camera(selection, &lists.points, view)?);
            files.add(format!("images/{i:08}.jpg"), Contents::Link(images.file(selection.scene.name(view))));
            names += &format!("{i}\t{}\n", selection.scene.name(view));
        }
        files.add_text("view_names.txt", names);
        for (name, script) in self.scripts {
            files.add(*name, Contents::Script(script.as_bytes().to_vec()));
        }
        let mut record = self.record(selection, &lists);
        record.moved(near.origin);
        files.add_text("export.json", record.to_json());
        Ok(Export { files, record })
    }

    /// Line 0 `extrinsic`, 1-4 world to camera, 6 `intrinsic`, 7-9 K, 11 depths; lines 5 and 10 are empty.
    fn camera(&self, selection: &Selection, points: &ViewPoints, view: ViewIndex) -> Result<String, BackendError> {
        let scene = selection.scene;
        let pose = &scene.view(view).cam_from_world;
        let row = |i: usize| {
            let r = pose.rotation.matrix().row(i);
            format!("{} {} {} {}\n", r[0], r[1], r[2], pose.translation[i])
        };
        let (f, c) = scene.camera_of(view).pinhole_part();
        let depths =
            self.depth_line(selection::depth_range(scene, points, view).ok_or_else(|| BackendError::Needs {
                backend: self.backend.name,
                what: format!("a depth range, and {} observes no sparse point in front of it", scene.name(view)),
                hint: "leave the view out of the model".into(),
            })?);
        Ok(format!(
            "extrinsic\n{}{}{}0 0 0 1\n\nintrinsic\n{} 0 {}\n0 {} {}\n0 0 1\n\n{depths}\n",
            row(0),
            row(1),
            row(2),
            f.x,
            c.x,
            f.y,
            c.y
        ))
    }

    fn depth_line(&self, [least, greatest]: [f64; 2]) -> String {
        // ACMM itself widens the range, by factors of 0.6 and 1.2.
        let margin = if self.all_are_problems { 0.0 } else { 0.1 };
        let (least, greatest) = (least * (1.0 - margin), greatest * (1.0 + margin));
        match self.depths {
            DepthLine::Interval => {
                format!("{least} {} {PLANES} {greatest}", (greatest - least) / f64::from(PLANES - 1))
            }
            DepthLine::Range => format!("{least} {greatest}"),
        }
    }

    fn record(&self, selection: &Selection, lists: &Lists) -> ExportRecord {
        let mut numbers = vec![0; selection.scene.views.len()];
        lists.views.iter().zip(&lists.numbers).for_each(|(v, number)| numbers[v.index()] = *number);
        let mut record = ExportRecord::new(self.backend, selection, |v| numbers[v.index()].to_string());
        let most = selection.most_partners();
        record.made_for = self.made_for.into();
        record.way = format!("dialect {}", self.backend.name);
        let sides = |side: fn(&Camera) -> u32| lists.views.iter().map(move |&v| side(selection.scene.camera_of(v)));
        let scaled = |side: Option<u32>| (f64::from(side.unwrap_or(0)) * selection.image_scale.min(1.0)) as u32;
        let longest = scaled(sides(|camera| camera.width.max(camera.height)).max());
        let size = if selection.image_scale < 1.0 { format!(" --image_max_dim {longest}") } else { String::new() };
        let words = [
            ("VIEWS", (most + 1).to_string()),
            ("PARTNERS", most.to_string()),
            ("WIDTH", scaled(sides(|camera| camera.width).min()).to_string()),
            ("HEIGHT", scaled(sides(|camera| camera.height).min()).to_string()),
            ("AGREEING", AGREEING.to_string()),
            ("SIZE", size),
        ];
        let filled =
            |command: &&str| words.iter().fold(String::from(*command), |text, (word, with)| text.replace(word, with));
        record.commands = self.commands.iter().map(filled).collect();
        if !self.commands.iter().any(|command| command.contains("SIZE")) {
            record.note_own_scale(selection);
        }
        record.other_maps = lists.rows.len() - selection.clusters.len();
        record.fusion = format!(
            "{AGREEING} agreeing view of pair_fuse.txt (PatchmatchNet: geo_mask_thres, CasMVSNet: thres_view, 5 by default): the plan asks for {} \
             maps of a place",
            AGREEING + 1
        );
        if self.all_are_problems {
            record.not_honoured.push("depth maps of key views only: every view of a cluster gets one".into());
            record.warnings.push("ACMH takes the second GPU and fails where there is one only".into());
            let cut = selection.clusters.iter().filter(|c| c.partners.len() > ACM_PARTNERS);
            record.warnings.extend(
                cut.map(|c| format!("{}: partners beyond the first {ACM_PARTNERS}", selection.scene.name(c.key))),
            );
        }
        record
    }
}

/// Lists of views (positions in `views`) and of the number of points they share with each.
struct Lists<'a> {
    views: &'a [ViewIndex],
    /// Number of each view in the files: its image id, the same in each plan, so that old maps keep their images; its position for
    /// programs that demand it.
    numbers: Vec<u32>,
    points: ViewPoints,
    /// Partners of each view that gets a map, key views first.
    rows: Vec<Vec<(u32, u32)>>,
    /// For each key view those whose maps may confirm its depths: not only partners, since key views are chosen to overlap little.
    compared: Vec<Vec<(u32, u32)>>,
}

impl<'a> Lists<'a> {
    fn new(dialect: &Dialect, selection: &Selection, views: &'a [ViewIndex]) -> Self {
        let scene = selection.scene;
        let points = scene.view_points();
        let mut index = vec![u32::MAX; scene.views.len()];
        (0..).zip(views).for_each(|(i, v)| index[v.index()] = i);
        // ACMM drops partners with a score of 0.
        let scored = |shared: &[u32], partners: &mut dyn Iterator<Item = ViewIndex>| {
            partners.map(|p| (index[p.index()], shared[p.index()].max(1))).collect::<Vec<_>>()
        };
        let most_shared = |shared: &[u32], among: &[ViewIndex], most: usize| {
            let mut others: Vec<_> = among.iter().copied().filter(|v| shared[v.index()] > 0).collect();
            others.sort_by_key(|v| std::cmp::Reverse(shared[v.index()]));
            scored(shared, &mut others.into_iter().take(most))
        };
        let keys = &views[..selection.clusters.len()];
        let key_rows = |c: &RankedCluster| {
            let shared = selection::shared_points(scene, &points, c.key);
            (scored(&shared, &mut c.partners.iter().copied()), most_shared(&shared, keys, FUSED_WITH))
        };
        let other_row = |&view: &ViewIndex| {
            most_shared(&selection::shared_points(scene, &points, view), views, selection.most_partners())
        };
        let (mut rows, compared): (Vec<_>, Vec<_>) = selection.clusters.iter().map(key_rows).unzip();
        if dialect.all_are_problems {
            rows.extend(views[rows.len()..].iter().map(other_row));
            rows.iter_mut().for_each(|row| row.truncate(ACM_PARTNERS));
        }
        let number = |(i, v): (u32, &ViewIndex)| if dialect.all_are_problems { i } else { scene.view(*v).image_id };
        Self { views, numbers: (0..).zip(views).map(number).collect(), points, rows, compared }
    }

    /// `pair.txt` with these lists of the first views.
    fn text(&self, rows: &[Vec<(u32, u32)>]) -> String {
        let mut text = format!("{}\n", rows.len());
        for (key, row) in self.numbers.iter().zip(rows) {
            text += &format!("{key}\n{} ", row.len());
            row.iter().for_each(|(view, score)| text += &format!("{} {score} ", self.numbers[*view as usize]));
            text.push('\n');
        }
        text
    }
}
