//! The lists of partners, and of maps that fusion compares.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use super::{ACM_PARTNERS, dialects::Dialect};
use crate::{
    backends::{
        Selection,
        selection::{self, FUSED_WITH},
    },
    model::{
        cluster::RankedCluster,
        scene::{ViewIndex, ViewPoints},
    },
};

/// A key view and others, best first, each with the number of points that they share; views by
/// their numbers in the files.
#[derive(Clone, Serialize, Deserialize)]
pub(super) struct Entry {
    pub key: u32,
    pub others: Vec<(u32, u32)>,
}

/// Returns `pair.txt` with these entries.
pub(super) fn pair_file(entries: &[Entry]) -> String {
    let mut text = format!("{}\n", entries.len());
    for Entry { key, others } in entries {
        text += &format!("{key}\n{} ", others.len());
        let other = |(view, shared): &(u32, u32)| format!("{view} {shared} ");
        text.extend(others.iter().map(other));
        text.push('\n');
    }
    text
}

/// Lists of views (positions in `views`) and of the number of points they share with each.
pub(super) struct Lists<'a> {
    pub views: &'a [ViewIndex],
    /// Number of each view in the files: its image id, the same in each plan, so that old maps keep
    /// their images; its position for programs that demand it.
    pub numbers: Vec<u32>,
    /// Width and height of the picture of each view, which may not be those of its camera, pixels.
    pub sizes: Vec<[u32; 2]>,
    /// Longest side of all pictures, pixels.
    pub longest: u32,
    pub points: ViewPoints,
    /// Partners of each view that gets a map, key views first.
    pub rows: Vec<Vec<(u32, u32)>>,
    /// For each key view those whose maps may confirm its depths, best first: not only partners,
    /// since key views are chosen to overlap little. With a [fusion](Dialect::fusion), enough of
    /// them for any number of first maps.
    compared: Vec<Vec<(u32, u32)>>,
}

/// Number of points that a view shares with each view of the scene.
struct SharedPoints<'a> {
    /// Position of each view of the scene in the files.
    positions: &'a [u32],
    shared: Vec<u32>,
}

impl SharedPoints<'_> {
    /// A list of these views: ACMM drops partners with a score of 0.
    fn row(&self, views: impl Iterator<Item = ViewIndex>) -> Vec<(u32, u32)> {
        views
            .map(|v| (self.positions[v.index()], self.shared[v.index()].max(1)))
            .collect()
    }

    /// A list of the views that share most points, if any.
    fn most(&self, among: &[ViewIndex], most: usize) -> Vec<(u32, u32)> {
        let shared = |v: &ViewIndex| self.shared[v.index()];
        let mut others: Vec<ViewIndex> = among.iter().copied().filter(|v| shared(v) > 0).collect();
        // A stable sort: ties stay in the order of `among`.
        others.sort_by_key(|v| std::cmp::Reverse(shared(v)));
        self.row(others.into_iter().take(most))
    }
}

/// Width and height of the pictures of views, pixels.
fn picture_sizes(selection: &Selection, views: &[ViewIndex]) -> Vec<[u32; 2]> {
    let other_size = selection.image_faults.other_size.iter().copied();
    let others: BTreeMap<ViewIndex, [u32; 2]> = other_size.collect();
    let size = |view: &ViewIndex| {
        let camera = selection.scene.camera_of(*view);
        let other = others.get(view);
        other.map_or([camera.width, camera.height], |size| *size)
    };
    views.iter().map(size).collect()
}

/// Keeps those of a list with which the map of the key view at `position` is fused.
fn retain_fused(compared: &mut Vec<(u32, u32)>, position: usize) {
    let others: Vec<usize> = compared.iter().map(|(other, _)| *other as usize).collect();
    let fused: BTreeSet<usize> = selection::fused_with(position, &others)
        .into_iter()
        .collect();
    compared.retain(|(other, _)| fused.contains(&(*other as usize)));
}

impl<'a> Lists<'a> {
    pub fn new(dialect: &Dialect, selection: &Selection, views: &'a [ViewIndex]) -> Self {
        let scene = selection.scene;
        let points = scene.view_points();
        let mut positions = vec![u32::MAX; scene.views.len()];
        (0..).zip(views).for_each(|(i, v)| positions[v.index()] = i);
        let shared_with = |view| SharedPoints {
            positions: &positions,
            shared: selection::shared_points(scene, &points, view),
        };
        let keys = &views[..selection.clusters.len()];
        let key_rows = |(i, cluster): (usize, &RankedCluster)| {
            let shared = shared_with(cluster.key);
            let mut compared = shared.most(keys, keys.len());
            if dialect.fusion.is_some() {
                retain_fused(&mut compared, i);
            } else {
                compared.truncate(FUSED_WITH);
            }
            (shared.row(cluster.partners.iter().copied()), compared)
        };
        let other_row =
            |&view: &ViewIndex| shared_with(view).most(views, selection.most_partners());
        let (mut rows, compared): (Vec<_>, Vec<_>) =
            selection.clusters.iter().enumerate().map(key_rows).unzip();
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
        let sizes = picture_sizes(selection, views);
        Self {
            views,
            longest: sizes.iter().copied().flatten().max().unwrap_or(0),
            sizes,
            numbers: (0..).zip(views).map(number).collect(),
            points,
            rows,
            compared,
        }
    }

    /// `pair.txt` with the lists of these key views (positions).
    pub fn pairs(&self, keys: &[usize]) -> String {
        let listed = keys.iter().filter(|&&i| i < self.rows.len());
        pair_file(&Vec::from_iter(listed.map(|&i| self.partners(i))))
    }

    /// The partners of a key view (position).
    pub fn partners(&self, key: usize) -> Entry {
        self.entry(key, &self.rows[key])
    }

    /// The key views whose maps may confirm the depths of one (position).
    pub fn compared(&self, key: usize) -> Entry {
        self.entry(key, &self.compared[key])
    }

    fn entry(&self, key: usize, row: &[(u32, u32)]) -> Entry {
        let numbered = |&(view, shared): &(u32, u32)| (self.numbers[view as usize], shared);
        Entry {
            key: self.numbers[key],
            others: row.iter().map(numbered).collect(),
        }
    }

    /// `tuples.txt`: for each key view a line of the scan and model (as MVSAnywhere names a scan
    /// with a model of COLMAP), its id and those of its partners.
    pub fn tuples(&self) -> String {
        let tuple = |(key, row): (&u32, &Vec<(u32, u32)>)| {
            let partners = row.iter().map(|(view, _)| self.numbers[*view as usize]);
            let ids = std::iter::once(*key)
                .chain(partners)
                .map(|id| format!(" {id}"));
            format!("scene:0{}\n", ids.collect::<String>())
        };
        self.numbers.iter().zip(&self.rows).map(tuple).collect()
    }

    /// `pair_fuse.txt`: for each key view those whose maps may confirm its depths, if all have one.
    pub fn pairs_to_fuse(&self) -> String {
        let first = |key| {
            let mut entry = self.compared(key);
            entry.others.truncate(FUSED_WITH);
            entry
        };
        pair_file(&Vec::from_iter((0..self.compared.len()).map(first)))
    }
}
