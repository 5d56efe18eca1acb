//! The tasks of an export for PatchmatchNet: `run.json`, and how its `eval.py` computes and joins
//! what it lists.
//!
//! `eval.py` computes all of a list, writes in place, and joins the maps of every view in a list,
//! of one size. So each map is made in a folder of its own, from a list of one entry, and moved to
//! its place if it is whole. The cloud is made in such a folder, too, from a list of the finished
//! maps, of which those of another size are copied with the nearest pixel at each place.

use std::{collections::BTreeSet, env, ffi::OsString, path::Path};

use serde::{Deserialize, Serialize};

use super::{
    AGREEING, Commands, PATCHMATCHNET,
    lists::{Entry, Lists, pair_file},
    sizes::{limit, reduced},
};
use crate::{
    backends::{
        Call, Export, Product, Selection, TaskProgram, TaskRunner, Tasks,
        clusters::{task_ids, task_marker},
        runner::{refuse_other_shape, refuse_unfit, text, words},
        selection::FUSED_WITH,
        strangers::with_refusal,
    },
    base::pixels::PixelBound,
    io::{
        depthmaps::{DepthMapFormat, pfm},
        output::{self, FileSet},
        ply,
    },
    model::cluster::{MapScale, RankedCluster},
};

pub const RUN: &str = "run.json";
pub const TASKS: Tasks = Tasks {
    program: TaskProgram {
        name: "eval.py",
        variable: "PATCHMATCHNET",
    },
    runner: tasks,
};
const CLOUD: &str = "depths/fused.ply";
/// Folders of the files that `eval.py` writes for a view. The depth map comes last: once it is in
/// place, all is.
const KINDS: [&str; 2] = ["confidence", "depth_est"];
/// Weights that come with the program, beside `eval.py`.
const CHECKPOINT: &str = "checkpoints/params_000007.ckpt";

/// Content of `run.json`.
#[derive(Serialize, Deserialize)]
pub struct Run {
    /// Longest side to which the fusion reduces images, pixels; `None` at their own size.
    fused_at: Option<u32>,
    maps: Vec<Row>,
}

/// The depth map of a view cluster.
#[derive(Serialize, Deserialize)]
struct Row {
    /// From 1.
    rank: usize,
    /// Content of its mark.
    id: String,
    partners: Entry,
    /// Key views whose maps may confirm its depths, enough of them for any number of first maps.
    compared: Entry,
    /// Longest side to which images are reduced, pixels; `None` at their own size.
    longest: Option<u32>,
    /// Width and height of the map, pixels.
    size: [u32; 2],
    /// The same when it is fused.
    fused_size: [u32; 2],
}

/// Last line of a script that cannot join the maps.
const TWO_SIZES: &str = "say 'The maps have two sizes: viewrank run PROJECT --fuse joins them.'";

/// Folders of the finished maps and their confidences.
pub fn folders() -> [String; 2] {
    KINDS.map(|kind| format!("depths/{kind}"))
}

fn file_of(kind: &str, key: u32) -> String {
    format!("depths/{kind}/{key:08}.pfm")
}

fn tasks(selection: &Selection, export: &Export) -> TaskRunner {
    let root = &export.files.root;
    let key = |cluster: &RankedCluster| selection.scene.view(cluster.key).image_id;
    let map = |cluster| Some(root.join(file_of("depth_est", key(cluster))));
    TaskRunner {
        python: Some("name a Python with the packages of PatchmatchNet in PYTHON"),
        commands,
        is_whole,
        finish,
        lists: &[RUN],
        own: "",
        clouds: vec![root.join(CLOUD)],
        sizes_share_a_file: true,
        maps: selection.clusters.iter().map(map).collect(),
    }
}

/// Contents of the marks of the maps of a plan, in rank order.
pub fn ids(selection: &Selection) -> Vec<String> {
    let id = |cluster| task_ids(&PATCHMATCHNET, selection, cluster)[0].clone();
    selection.clusters.iter().map(id).collect()
}

impl Row {
    /// Its rank, and the content of the mark of its map.
    fn task(&self) -> (usize, &str) {
        (self.rank, &self.id)
    }

    fn key(&self) -> u32 {
        self.partners.key
    }
}

impl Run {
    /// The tasks of an export: `ids` of the clusters; key views are the first of the lists.
    pub(super) fn new(
        selection: &Selection,
        lists: &Lists,
        ids: Vec<String>,
        fused_at: MapScale,
    ) -> Self {
        let limit = |scale| limit(selection, lists, scale);
        let row = |((i, cluster), id): ((usize, &RankedCluster), String)| Row {
            rank: i + 1,
            id,
            partners: lists.partners(i),
            compared: lists.compared(i),
            longest: limit(cluster.scale),
            size: reduced(lists.sizes[i], limit(cluster.scale)),
            fused_size: reduced(lists.sizes[i], limit(fused_at)),
        };
        Self {
            fused_at: limit(fused_at),
            maps: selection
                .clusters
                .iter()
                .enumerate()
                .zip(ids)
                .map(row)
                .collect(),
        }
    }

    /// Returns `run.sh`.
    pub fn script(&self, selection: &Selection, commands: &Commands) -> String {
        let keys = selection
            .clusters
            .iter()
            .map(|c| selection.scene.name(c.key));
        let markers: Vec<String> = keys.map(task_marker).collect();
        let marks = |word: &str| -> String {
            let marks = markers.iter().zip(&self.maps);
            marks
                .map(|(marker, row)| format!("{word} {marker} {}\n", row.id))
                .collect()
        };
        let head = with_refusal(include_str!("../../../integrations/mvsnet/run_head.sh"));
        let (before, after) = (marks("begin"), marks("mark"));
        let depth = commands.depth.join("\n");
        let fusion = commands.fusion.as_deref().unwrap_or(TWO_SIZES);
        format!("{head}{before}{depth}\n{after}{fusion}\n")
    }

    fn finished(&self, call: &Call) -> impl Iterator<Item = &Row> {
        self.maps.iter().filter(|row| call.is_finished(row.rank))
    }

    /// The list of the finished maps, each with the best of those whose maps may confirm it.
    fn fused(&self, call: &Call) -> Vec<Entry> {
        let there: BTreeSet<u32> = self.finished(call).map(Row::key).collect();
        let fused = self.finished(call).map(|row| {
            let mut entry = row.compared.clone();
            entry.others.retain(|(key, _)| there.contains(key));
            entry.others.truncate(FUSED_WITH);
            entry
        });
        // eval.py fails on a view without any.
        fused.filter(|entry| !entry.others.is_empty()).collect()
    }
}

/// Lays out the input of a task, and returns the command that does it there.
pub fn commands(call: &Call) -> Result<Vec<Vec<OsString>>, String> {
    let run: Run = call.read(RUN)?;
    let mut files = FileSet::new(call.work, "input");
    let (entries, longest, options) = match call.product {
        Product::Map(rank) => {
            let row = call.row_of(rank, &run.maps, Row::task)?;
            let partners = row.partners.others.len();
            // eval.py counts the partners alone, where MVSNet counts the key view, too.
            let options = format!("--output_type depth --num_views {partners}");
            (vec![row.partners.clone()], row.longest, options)
        }
        Product::Cloud => {
            let options = format!("--output_type fusion --geo_mask_thres {AGREEING}");
            (run.fused(call), run.fused_at, options)
        }
    };
    if entries.is_empty() {
        return Err("no two of the finished maps share points: nothing to join".into());
    }
    let others = entries
        .iter()
        .flat_map(|entry| entry.others.iter().map(|(view, _)| *view));
    let views: BTreeSet<u32> = entries
        .iter()
        .map(|entry| entry.key)
        .chain(others)
        .collect();
    for view in &views {
        for path in [
            format!("cams/{view:08}_cam.txt"),
            format!("images/{view:08}.jpg"),
        ] {
            files.add(&*path, call.link(&path));
        }
    }
    files.add_text("pair.txt", pair_file(&entries));
    if call.product == Product::Cloud {
        let rows = run.finished(call).filter(|row| views.contains(&row.key()));
        add_maps(rows, call, &mut files)?;
    }
    files.write(&call.disk()).map_err(text)?;
    let limit = longest.map(|side| format!(" --image_max_dim {side}"));
    let options = options + &limit.unwrap_or_default();
    Ok(vec![command(call, &options)])
}

fn command(call: &Call, options: &str) -> Vec<OsString> {
    let folder = call.program.parent().unwrap_or(Path::new(""));
    let named = env::var_os("CHECKPOINT").filter(|named| !named.is_empty());
    let mut command = words([
        &call.python,
        &call.program,
        &"--input_folder",
        &call.work,
        &"--output_folder",
        &call.work.join("depths"),
        &"--checkpoint_path",
        // A relative path is seen from the program's folder, as in `run.sh`, which changes to that.
        &folder.join(named.unwrap_or_else(|| CHECKPOINT.into())),
    ]);
    command.extend(options.split(' ').map(OsString::from));
    command
}

/// Adds maps and their confidences, in the size in which they are fused.
fn add_maps<'a>(
    rows: impl Iterator<Item = &'a Row>,
    call: &Call,
    files: &mut FileSet,
) -> Result<(), String> {
    for row in rows {
        for kind in KINDS {
            let path = file_of(kind, row.key());
            let linked = call.made(&path)?;
            let map = call.workplace.join(&path);
            let made = pfm::whole_size(&map).map_err(text)?;
            if made == row.fused_size {
                files.add(&*path, linked);
                continue;
            }
            let pixels = made.map(u64::from).iter().product();
            let copy = pfm::resized(&map, PixelBound::new(pixels), row.fused_size);
            // At once, since all of them need not fit into memory.
            let to = call.work.join(&path);
            output::make_folder(to.parent().unwrap_or(call.work), &call.disk()).map_err(text)?;
            output::replace(&to, &copy.map_err(text)?, &call.disk()).map_err(text)?;
        }
    }
    Ok(())
}

/// Checks what `eval.py` has made, and puts it in its place.
pub fn finish(call: &Call) -> Result<(), String> {
    match call.product {
        Product::Map(rank) => {
            let run: Run = call.read(RUN)?;
            let row = call.row_of(rank, &run.maps, Row::task)?;
            let [confidence, depth] = KINDS.map(|kind| file_of(kind, row.key()));
            refuse_unfit(&call.work.join(&depth), DepthMapFormat::Pfm, row.size)?;
            let made = pfm::whole_size(&call.work.join(&confidence)).map_err(text)?;
            refuse_other_shape("map of confidences", made, row.size)?;
            call.place(&confidence)?;
            call.place(&depth)
        }
        Product::Cloud => {
            let points = ply::counts(&call.work.join(CLOUD)).map_or(0, |[points, _]| points);
            if points == 0 {
                return Err("eval.py fused no points".into());
            }
            call.place(CLOUD)
        }
    }
}

/// Returns whether a depth map is all there, with its confidences.
pub fn is_whole(map: &Path) -> bool {
    let folder = map.parent().map(|folder| folder.with_file_name(KINDS[0]));
    let confidences = folder
        .zip(map.file_name())
        .map(|(folder, name)| folder.join(name));
    let size = pfm::whole_size(map).ok();
    size.is_some() && size == confidences.and_then(|path| pfm::whole_size(&path).ok())
}
