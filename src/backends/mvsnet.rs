//! MVSNet and the programs that read its files: `docs/backends.md` 3 and 14. `pair.txt` lists the
//! key views with their partners, `cams/` contains the cameras; the readers differ in the depth
//! line of a camera and in which views they expect.

use std::collections::BTreeSet;

use super::{
    Backend, BackendError, Capabilities, ExaminedProject, Export, ExportOptions, ExportRecord,
    Honours, PATCH_MATCH, PlanningNumbers, Selection, Trap, selection,
    strangers::{list_links, with_refusal},
};
use crate::{
    io::output::{Contents, FileSet},
    method::confidence::Photometric,
    model::{
        camera::Camera,
        cluster::{MapScale, RankedCluster},
        scene::{ViewIndex, ViewPoints},
    },
};

/// A dialect of the family.
struct Dialect {
    backend: &'static Backend,
    made_for: &'static str,
    depths: DepthLine,
    /// True for ACMM and its relatives: they look partners up by position and fuse with the maps of
    /// all partners, so every image needs a map.
    all_are_problems: bool,
    /// Makes the depth maps of one size. With INPUT (folder of that size below the export), VIEWS
    /// (partners and key view), PARTNERS, WIDTH and HEIGHT (no image is smaller), SIZE
    /// (PatchmatchNet's option where images are reduced).
    depth: &'static str,
    /// Joins the maps; `None` where the program does that by a command of its own, of one size
    /// only.
    join: Option<Join>,
}

/// How a program joins depth maps, of two sizes too.
struct Join {
    /// With AGREEING (partners that must agree), SIZE. They leave `fuse/fused.ply`.
    commands: &'static [&'static str],
    /// Name and contents of the script that the commands call.
    script: (&'static str, &'static str),
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
/// Number of partners that must agree on a depth: one less than the plan's support, which includes
/// the key view.
const AGREEING: u32 = PATCH_MATCH.support - 1;
/// Largest number of key views whose maps the fusion compares with one: its own lists hold every
/// view that shares points, which takes long.
const FUSED_WITH: usize = 24;
/// Script with the commands of a program that joins by one of its own.
const RUNNER: &str = "run.sh";
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
    takes_masks: false,
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
    depth: "(here=$PWD && cd \"${MVSNET:?folder of its test.py}\" && python test.py --dense_folder \"$here\" --view_num VIEWS \
            --max_w WIDTH --max_h HEIGHT --interval_scale 1 --pretrained_model_ckpt_path \"${CHECKPOINT:?path of model.ckpt}\" \
            --ckpt_step \"${STEP:?its step}\")",
    join: None,
};

pub static PATCHMATCHNET: Backend = Backend {
    name: "patchmatchnet",
    aliases: &["patchmatch"],
    capabilities: Capabilities {
        notes: "its own filter opens the maps of all views in its list: finished.py makes fuse/, with those that have one",
        ..CAPABILITIES
    },
    planning: PlanningNumbers {
        photometric: Photometric {
            agree: 0.5,
            differ: 0.05,
            full_agreement: 0.9,
        },
        measured: "5 sets, in part",
        source: "agreement: what its fusion keeps of 219 maps of 974abc0 (CPU) of boruszyn, lewis, statue and room; valley took no part and is foreseen \
                 better too (method 7.4); support 2: its fusion wants one other map that agrees; gate: the numbers of OpenMVS (method 7.1)",
        ..PATCH_MATCH
    },
    mixes_sizes: true,
    export: |selection, options| PATCHMATCHNET_DIALECT.export(selection, options),
    ..MVSNET
};

const PATCHMATCHNET_DIALECT: Dialect = Dialect {
    backend: &PATCHMATCHNET,
    made_for: "PatchmatchNet and readers of its two-number depth line",
    depths: DepthLine::Range,
    all_are_problems: false,
    depth: "(here=$PWD && cd \"${PATCHMATCHNET:?its folder}\" && python eval.py --input_folder \"$hereINPUT\" --output_folder \"$here/depths\" \
            --checkpoint_path \"${CHECKPOINT:-checkpoints/params_000007.ckpt}\" --num_views PARTNERSSIZE --output_type depth)",
    join: Some(Join {
        commands: &[
            "python3 finished.py",
            "(here=$PWD && cd \"$PATCHMATCHNET\" && python eval.py --input_folder \"$here/fuse\" --output_folder \"$here/fuse\" \
             --checkpoint_path \"${CHECKPOINT:-checkpoints/params_000007.ckpt}\" --output_type fusion --geo_mask_thres AGREEINGSIZE)",
        ],
        script: (
            "finished.py",
            include_str!("../../integrations/mvsnet/finished.py"),
        ),
    }),
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
    depth: "\"${ACMM:-ACMM}\" .",
    join: None,
};

const CAPABILITIES: Capabilities = Capabilities {
    partners: Honours::Yes,
    key_subset: Honours::Yes,
    order: Honours::Yes,
    fusion: "the reader's own filter, with pair_fuse.txt",
    notes: "",
};

fn traps(patient: &ExaminedProject) -> Vec<Trap> {
    patient
        .without_points("mvsnet-depth-range", "its depth line cannot be written")
        .into_iter()
        .collect()
}

impl Dialect {
    fn export(
        &self,
        selection: &Selection,
        options: &ExportOptions,
    ) -> Result<Export, BackendError> {
        let near = selection.near_origin();
        let selection = &near.selection();
        let views = selection.keys_first();
        let lists = Lists::new(self, selection, &views);
        let mut files = options.file_set(self.backend, selection);
        let all: Vec<usize> = (0..views.len()).collect();
        let (half, full): (Vec<usize>, Vec<usize>) =
            all.iter().partition(|&&i| self.is_half(selection, i));
        files.add_text("pair.txt", lists.pairs(&full));
        files.add_text("pair_fuse.txt", lists.pairs_to_fuse(&all));
        self.add_views(&mut files, "", selection, &lists, &all)?;
        if !half.is_empty() {
            self.add_half(&mut files, selection, &lists, &half)?;
        }
        files.add_text("view_names.txt", self.view_names(selection, &lists));
        let mut record = self.record(selection, &lists);
        if let Some(Join {
            script: (name, script),
            ..
        }) = self.join
        {
            files.add_text(
                "sizes.txt",
                sizes(selection, &lists, self.fused_at(selection)),
            );
            files.add(name, Contents::Script(script.as_bytes().to_vec()));
            let keys: Vec<usize> = (0..selection.clusters.len()).collect();
            self.add_views(&mut files, "fuse/", selection, &lists, &keys)?;
            files.add(RUNNER, runner(&record.commands));
            record.runner = Some(RUNNER.into());
        }
        record.moved(near.origin);
        list_links(&mut files);
        files.add_text("export.json", record.to_json());
        Ok(Export { files, record })
    }

    /// Numbers and names: of all views where the number is the id of the image, since maps of
    /// earlier plans may be there.
    fn view_names(&self, selection: &Selection, lists: &Lists) -> String {
        let scene = selection.scene;
        let line = |number: u32, view| format!("{number}\t{}\n", scene.name(view));
        match self.all_are_problems {
            true => lists
                .numbers
                .iter()
                .zip(lists.views)
                .map(|(&number, &view)| line(number, view))
                .collect(),
            false => scene
                .view_indices()
                .map(|view| line(scene.view(view).image_id, view))
                .collect(),
        }
    }

    /// Adds `half/`, the same files for the key views (positions) that are matched at half the
    /// size.
    fn add_half(
        &self,
        files: &mut FileSet,
        selection: &Selection,
        lists: &Lists,
        half: &[usize],
    ) -> Result<(), BackendError> {
        let clusters = half.iter().map(|&i| &selection.clusters[i]);
        let members =
            clusters.flat_map(|c| std::iter::once(c.key).chain(c.partners.iter().copied()));
        let members: BTreeSet<ViewIndex> = members.collect();
        let members: Vec<usize> = (0..lists.views.len())
            .filter(|&i| members.contains(&lists.views[i]))
            .collect();
        files.add_text("half/pair.txt", lists.pairs(half));
        self.add_views(files, "half/", selection, lists, &members)
    }

    /// Returns whether the view of this position, key views first, gets a map of half the size.
    fn is_half(&self, selection: &Selection, view: usize) -> bool {
        self.backend.mixes_sizes
            && selection
                .clusters
                .get(view)
                .is_some_and(|c| c.scale == MapScale::Half)
    }

    /// Size in which maps of two sizes are joined: the largest that is planned.
    fn fused_at(&self, selection: &Selection) -> MapScale {
        let is_any_full = (0..selection.clusters.len()).any(|i| !self.is_half(selection, i));
        if is_any_full {
            MapScale::Full
        } else {
            MapScale::Half
        }
    }

    /// Adds cameras and images of the views of these positions.
    fn add_views(
        &self,
        files: &mut FileSet,
        folder: &str,
        selection: &Selection,
        lists: &Lists,
        positions: &[usize],
    ) -> Result<(), BackendError> {
        let images = selection.undistorted_images(self.backend.name)?;
        for &at in positions {
            let (i, view) = (lists.numbers[at], lists.views[at]);
            files.add_text(
                format!("{folder}cams/{i:08}_cam.txt"),
                self.camera(selection, &lists.points, view)?,
            );
            files.add(
                format!("{folder}images/{i:08}.jpg"),
                images.link(selection.scene.name(view)),
            );
        }
        Ok(())
    }

    /// Line 0 `extrinsic`, 1-4 world to camera, 6 `intrinsic`, 7-9 K, 11 depths; lines 5 and 10 are
    /// empty.
    fn camera(
        &self,
        selection: &Selection,
        points: &ViewPoints,
        view: ViewIndex,
    ) -> Result<String, BackendError> {
        let scene = selection.scene;
        let pose = &scene.view(view).cam_from_world;
        let row = |i: usize| {
            let r = pose.rotation.matrix().row(i);
            format!("{} {} {} {}\n", r[0], r[1], r[2], pose.translation[i])
        };
        let (f, c) = scene.camera_of(view).pinhole_part();
        let depths =
            self.depth_line(selection::depth_range(scene, points, view).ok_or_else(|| {
                BackendError::Needs {
                    backend: self.backend.name,
                    what: format!(
                        "a depth range, and {} observes no sparse point in front of it",
                        scene.name(view)
                    ),
                    hint: "leave the view out of the model".into(),
                }
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
                format!(
                    "{least} {} {PLANES} {greatest}",
                    (greatest - least) / f64::from(PLANES - 1)
                )
            }
            DepthLine::Range => format!("{least} {greatest}"),
        }
    }

    fn record(&self, selection: &Selection, lists: &Lists) -> ExportRecord {
        let mut numbers = vec![0; selection.scene.views.len()];
        lists
            .views
            .iter()
            .zip(&lists.numbers)
            .for_each(|(v, number)| numbers[v.index()] = *number);
        let mut record =
            ExportRecord::new(self.backend, selection, |v| numbers[v.index()].to_string());
        record.made_for = self.made_for.into();
        record.way = format!("dialect {}", self.backend.name);
        let at_half = (0..selection.clusters.len())
            .filter(|&i| self.is_half(selection, i))
            .count();
        let words = |scale| Words::new(selection, lists, scale);
        if at_half < selection.clusters.len() || at_half == 0 {
            record.commands.push(words(MapScale::Full).fill(self.depth));
        }
        if at_half > 0 {
            record.commands.push(words(MapScale::Half).fill(self.depth));
        }
        let fused = words(self.fused_at(selection));
        record.commands.extend(
            self.join
                .iter()
                .flat_map(|join| join.commands)
                .map(|command| fused.fill(command)),
        );
        if !self.depth.contains("SIZE") {
            record.note_own_scale(selection);
        }
        record.other_maps = lists.rows.len() - selection.clusters.len();
        record.fusion = format!(
            "{AGREEING} agreeing view of pair_fuse.txt (PatchmatchNet: geo_mask_thres, CasMVSNet: thres_view, 5 by default): the plan asks for {} \
             maps of a place",
            AGREEING + 1
        );
        if self.join.is_some() {
            record.fusion += "; the cloud is fuse/fused.ply";
            record
                .not_honoured
                .extend(at_another_size(selection, lists));
        }
        if self.all_are_problems {
            record
                .not_honoured
                .push("depth maps of key views only: every view of a cluster gets one".into());
            record
                .warnings
                .push("ACMH takes the second GPU and fails where there is one only".into());
            let cut = selection
                .clusters
                .iter()
                .filter(|c| c.partners.len() > ACM_PARTNERS);
            record.warnings.extend(cut.map(|c| {
                format!(
                    "{}: partners beyond the first {ACM_PARTNERS}",
                    selection.scene.name(c.key)
                )
            }));
        }
        record
    }
}

/// Returns `run.sh`, which makes all maps and joins them.
fn runner(commands: &[String]) -> Contents {
    let lines: String = commands
        .iter()
        .map(|command| format!("{command}\n"))
        .collect();
    Contents::Script(with_refusal(&format!("{RUNNER_HEAD}{lines}")).into_bytes())
}

const RUNNER_HEAD: &str = include_str!("../../integrations/mvsnet/run_head.sh");

/// Returns for each key view a line of its number, width and height of its map in the size in which
/// maps are fused, and the same in the other size.
fn sizes(selection: &Selection, lists: &Lists, fused_at: MapScale) -> String {
    let scales = match fused_at {
        MapScale::Full => [MapScale::Full, MapScale::Half],
        MapScale::Half => [MapScale::Half, MapScale::Full],
    };
    let longest = scales.map(|scale| longest(selection, lists, matched_scale(selection, scale)));
    let line = |(number, cluster): (&u32, &RankedCluster)| {
        let camera = selection.scene.camera_of(cluster.key);
        let [[a, b], [c, d]] = longest.map(|longest| reduced(camera, longest));
        format!("{number} {a} {b} {c} {d}\n")
    };
    lists
        .numbers
        .iter()
        .zip(selection.clusters)
        .map(line)
        .collect()
}

/// Returns width and height of an image of the camera of which PatchmatchNet makes the longest side
/// at most `longest`; it rounds down.
fn reduced(camera: &Camera, longest: u32) -> [u32; 2] {
    let scale = (f64::from(longest) / f64::from(camera.width.max(camera.height))).min(1.0);
    [camera.width, camera.height].map(|side| (scale * f64::from(side)) as u32)
}

/// Matched size as a part of the image's.
fn matched_scale(selection: &Selection, scale: MapScale) -> f64 {
    selection.image_scale.min(1.0) * scale.factor()
}

/// Says how many key views are not matched at the planned size: the program reduces to one longest
/// side, whatever the image had.
fn at_another_size(selection: &Selection, lists: &Lists) -> Option<String> {
    let is_other = |cluster: &&RankedCluster| {
        let (camera, scale) = (
            selection.scene.camera_of(cluster.key),
            matched_scale(selection, cluster.scale),
        );
        let side = camera.width.max(camera.height);
        scale < 1.0
            && longest(selection, lists, scale).min(side) != (f64::from(side) * scale) as u32
    };
    let other = selection.clusters.iter().filter(is_other).count();
    (other > 0).then(|| {
        let plural = if other == 1 { "" } else { "s" };
        format!("planned size of {other} map{plural}: images are reduced to one longest side, so smaller ones are reduced less")
    })
}

/// Returns the longest side of an image that is matched at this size, pixels.
fn longest(selection: &Selection, lists: &Lists, scale: f64) -> u32 {
    let cameras = lists
        .views
        .iter()
        .map(|&view| selection.scene.camera_of(view));
    (f64::from(
        cameras
            .map(|camera| camera.width.max(camera.height))
            .max()
            .unwrap_or(0),
    ) * scale) as u32
}

/// The words of commands with their values.
struct Words([(&'static str, String); 7]);

impl Words {
    fn new(selection: &Selection, lists: &Lists, scale: MapScale) -> Self {
        let size = matched_scale(selection, scale);
        let sides = |side: fn(&Camera) -> u32| {
            lists
                .views
                .iter()
                .map(move |&v| side(selection.scene.camera_of(v)))
        };
        let scaled = |side: Option<u32>| (f64::from(side.unwrap_or(0)) * size) as u32;
        let most = selection.most_partners();
        let limit = || format!(" --image_max_dim {}", longest(selection, lists, size));
        Self([
            (
                "INPUT",
                if scale == MapScale::Half {
                    "/half".into()
                } else {
                    String::new()
                },
            ),
            ("VIEWS", (most + 1).to_string()),
            ("PARTNERS", most.to_string()),
            (
                "WIDTH",
                scaled(sides(|camera| camera.width).min()).to_string(),
            ),
            (
                "HEIGHT",
                scaled(sides(|camera| camera.height).min()).to_string(),
            ),
            ("AGREEING", AGREEING.to_string()),
            ("SIZE", if size < 1.0 { limit() } else { String::new() }),
        ])
    }

    fn fill(&self, command: &str) -> String {
        self.0
            .iter()
            .fold(command.into(), |text: String, (word, with)| {
                text.replace(word, with)
            })
    }
}

/// Lists of views (positions in `views`) and of the number of points they share with each.
struct Lists<'a> {
    views: &'a [ViewIndex],
    /// Number of each view in the files: its image id, the same in each plan, so that old maps keep
    /// their images; its position for programs that demand it.
    numbers: Vec<u32>,
    points: ViewPoints,
    /// Partners of each view that gets a map, key views first.
    rows: Vec<Vec<(u32, u32)>>,
    /// For each key view those whose maps may confirm its depths: not only partners, since key
    /// views are chosen to overlap little.
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
            partners
                .map(|p| (index[p.index()], shared[p.index()].max(1)))
                .collect::<Vec<_>>()
        };
        let most_shared = |shared: &[u32], among: &[ViewIndex], most: usize| {
            let mut others: Vec<_> = among
                .iter()
                .copied()
                .filter(|v| shared[v.index()] > 0)
                .collect();
            others.sort_by_key(|v| std::cmp::Reverse(shared[v.index()]));
            scored(shared, &mut others.into_iter().take(most))
        };
        let keys = &views[..selection.clusters.len()];
        let key_rows = |c: &RankedCluster| {
            let shared = selection::shared_points(scene, &points, c.key);
            (
                scored(&shared, &mut c.partners.iter().copied()),
                most_shared(&shared, keys, FUSED_WITH),
            )
        };
        let other_row = |&view: &ViewIndex| {
            most_shared(
                &selection::shared_points(scene, &points, view),
                views,
                selection.most_partners(),
            )
        };
        let (mut rows, compared): (Vec<_>, Vec<_>) =
            selection.clusters.iter().map(key_rows).unzip();
        if dialect.all_are_problems {
            rows.extend(views[rows.len()..].iter().map(other_row));
            rows.iter_mut().for_each(|row| row.truncate(ACM_PARTNERS));
        }
        let number = |(i, v): (u32, &ViewIndex)| {
            if dialect.all_are_problems {
                i
            } else {
                scene.view(*v).image_id
            }
        };
        Self {
            views,
            numbers: (0..).zip(views).map(number).collect(),
            points,
            rows,
            compared,
        }
    }

    /// `pair.txt` with the lists of these key views (positions).
    fn pairs(&self, keys: &[usize]) -> String {
        self.text(
            keys.iter()
                .filter_map(|&i| Some((i, self.rows.get(i)?.clone())))
                .collect(),
        )
    }

    /// `pair_fuse.txt`: for each of these key views those of them whose maps may confirm its
    /// depths.
    fn pairs_to_fuse(&self, keys: &[usize]) -> String {
        let chosen: BTreeSet<usize> = keys.iter().copied().collect();
        let among = |row: &[(u32, u32)]| {
            row.iter()
                .copied()
                .filter(|(v, _)| chosen.contains(&(*v as usize)))
                .collect()
        };
        self.text(
            keys.iter()
                .filter_map(|&i| Some((i, among(self.compared.get(i)?))))
                .collect(),
        )
    }

    fn text(&self, rows: Vec<(usize, Vec<(u32, u32)>)>) -> String {
        let mut text = format!("{}\n", rows.len());
        for (key, row) in rows {
            text += &format!("{}\n{} ", self.numbers[key], row.len());
            row.iter().for_each(|(view, score)| {
                text += &format!("{} {score} ", self.numbers[*view as usize])
            });
            text.push('\n');
        }
        text
    }
}
