//! MVSNet and the programs that read its files, in one table ([`dialects`]): `docs/backends.md` 3
//! and
//! 14. `pair.txt` lists the key views with their partners, `cams/` contains the cameras; the
//!     readers differ in the depth line of a camera and in which views they expect.

use std::collections::BTreeSet;

use self::{
    dialects::{DepthLine, Dialect},
    lists::Lists,
    run::Run,
    sizes::{Words, at_another_size},
};
use super::{
    BackendError, Export, ExportOptions, ExportRecord, PATCH_MATCH, Selection, selection,
    strangers::{add_runner, name_links_in_scripts},
};
use crate::{
    base::printable::to_json,
    io::output::{Contents, FileSet},
    model::{
        cluster::{MapScale, RankedCluster},
        scene::ViewIndex,
    },
};

mod dialects;
mod lists;
mod run;
mod sizes;

pub use dialects::{ACMM, MVSNET, PAIRS, PATCHMATCHNET};

/// Number of planes between the least and the greatest depth.
const PLANES: u32 = 192;
/// Number of partners that must agree on a depth: one less than the plan's support, which includes
/// the key view.
const AGREEING: u32 = PATCH_MATCH.support - 1;
/// Largest number of partners of ACMH, ACMM, ACMP and ACMMP, which use a 32-bit mask.
const ACM_PARTNERS: usize = 32;

/// The commands of `run.sh`.
struct Commands {
    /// One for the maps of each size.
    depth: Vec<String>,
    /// Joins the maps; `None` for two sizes, or if the program does that by itself.
    fusion: Option<String>,
}

impl Dialect {
    fn export(
        &self,
        selection: &Selection,
        options: &ExportOptions,
    ) -> Result<Export, BackendError> {
        let planned = selection;
        let near = planned.near_origin();
        let selection = &near.selection();
        let views = selection.keys_first();
        let lists = Lists::new(self, selection, &views);
        let mut files = options.file_set(self.backend, selection);
        let keys = selection.clusters.len();
        let all: Vec<usize> = (0..views.len()).collect();
        let (half, full): (Vec<usize>, Vec<usize>) =
            all.iter().partition(|&&i| self.is_half(selection, i));
        files.add_text("pair.txt", lists.pairs(&full));
        // A list of its own, since filters end at the first view in their list that has no map.
        files.add_text("pair_fuse.txt", lists.pairs_to_fuse());
        self.add_views(&mut files, "", selection, &lists, &all)?;
        if !half.is_empty() {
            self.add_half(&mut files, selection, &lists, &half)?;
        }
        files.add_text("view_names.txt", self.view_names(selection, &lists));
        if self.tuples {
            files.add_text("tuples.txt", lists.tuples());
        }
        let commands = self.commands(selection, &lists);
        let mut record = self.record(selection, &lists, &commands);
        record.moved(near.origin);
        if self.fusion.is_some() {
            for folder in run::folders() {
                files.add(folder, Contents::Folder);
            }
            if commands.fusion.is_some() {
                files.add_text("fuse/pair.txt", lists.pairs_to_fuse());
                self.add_views(&mut files, "fuse/", selection, &lists, &all[..keys])?;
            }
            // Of the plan, not of a scene that was moved.
            let ids = run::ids(planned);
            let run = Run::new(selection, &lists, ids, self.fused_at(selection));
            files.add_script("run.sh", run.script(selection, &commands));
            files.add_text(run::RUN, to_json(&run));
            record.runner = Some("run.sh".into());
            name_links_in_scripts(&mut files);
        } else if !record.commands.is_empty() {
            add_runner(&mut files, &mut record);
        }
        Ok(Export::new(files, record))
    }

    /// Numbers and names: of all views where the number is the id of the image, since maps of
    /// earlier plans may be there.
    fn view_names(&self, selection: &Selection, lists: &Lists) -> String {
        let scene = selection.scene;
        let line = |number: u32, view| format!("{number}\t{}\n", scene.name(view));
        if self.all_are_problems {
            lists
                .numbers
                .iter()
                .zip(lists.views)
                .map(|(&number, &view)| line(number, view))
                .collect()
        } else {
            scene
                .view_indices()
                .map(|view| line(scene.view(view).image_id, view))
                .collect()
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
        let members: BTreeSet<ViewIndex> = clusters.flat_map(RankedCluster::views).collect();
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
                self.camera(selection, lists, at)?,
            );
            files.add(
                // The readers ask for this extension, whatever the image is.
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
        lists: &Lists,
        at: usize,
    ) -> Result<String, BackendError> {
        let (scene, view) = (selection.scene, lists.views[at]);
        let pose = &scene.view(view).cam_from_world;
        let row = |i: usize| {
            let r = pose.rotation.matrix().row(i);
            format!("{} {} {} {}\n", r[0], r[1], r[2], pose.translation[i])
        };
        let camera = scene.camera_of(view);
        let (f, c) = camera.pinhole_part();
        // Of the picture as it is stored.
        let [x, y] = lists.sizes[at].map(f64::from);
        let [x, y] = [x / f64::from(camera.width), y / f64::from(camera.height)];
        let range = selection::depth_range(self.backend.name, scene, &lists.points, view)?;
        let depths = self.depth_line(range);
        Ok(format!(
            "extrinsic\n{}{}{}0 0 0 1\n\nintrinsic\n{} 0 {}\n0 {} {}\n0 0 1\n\n{depths}\n",
            row(0),
            row(1),
            row(2),
            x * f.x,
            x * c.x,
            y * f.y,
            y * c.y
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

    fn commands(&self, selection: &Selection, lists: &Lists) -> Commands {
        let at_half = (0..selection.clusters.len())
            .filter(|&i| self.is_half(selection, i))
            .count();
        let sizes = [
            // A plan without clusters has the command of full size.
            (at_half < selection.clusters.len() || at_half == 0).then_some(MapScale::Full),
            (at_half > 0).then_some(MapScale::Half),
        ];
        let sizes: Vec<MapScale> = sizes.into_iter().flatten().collect();
        let fill = |&scale, command| Words::new(selection, lists, scale).fill(command);
        let depth = sizes
            .iter()
            .filter_map(|scale| Some(fill(scale, self.depth?)));
        let fusion = match &*sizes {
            [scale] => self.fusion.map(|command| fill(scale, command)),
            _ => None,
        };
        Commands {
            depth: depth.collect(),
            fusion,
        }
    }

    fn record(&self, selection: &Selection, lists: &Lists, commands: &Commands) -> ExportRecord {
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
        record.commands = commands
            .depth
            .iter()
            .chain(&commands.fusion)
            .cloned()
            .collect();
        if !self.depth.is_some_and(|depth| depth.contains("SIZE")) {
            record.note_own_scale(selection);
        }
        record.other_maps = lists.rows.len() - selection.clusters.len();
        record.fusion = format!(
            "{AGREEING} agreeing view of pair_fuse.txt (PatchmatchNet: geo_mask_thres, CasMVSNet: thres_view, 5 by default): the plan asks for {} \
             maps of a place",
            AGREEING + 1
        );
        if self.fusion.is_some() {
            record.fusion += "; the cloud is depths/fused.ply";
            record
                .not_honoured
                .extend(at_another_size(selection, lists));
        }
        if self.all_are_problems {
            note_acm(&mut record, selection);
        }
        record
    }
}

/// Notes what ACMM and ACMH do in another way.
fn note_acm(record: &mut ExportRecord, selection: &Selection) {
    record
        .not_honoured
        .push("depth maps of key views only: every view of a cluster gets one".into());
    record
        .warnings
        .push("ACMH takes the second GPU and fails where there is one only".into());
    let clusters = selection.clusters.iter();
    let cut = clusters.filter(|c| c.partners.len() > ACM_PARTNERS);
    record.warnings.extend(cut.map(|c| {
        let key = selection.scene.name(c.key);
        format!("{key}: partners beyond the first {ACM_PARTNERS}")
    }));
}
