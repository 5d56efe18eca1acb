//! Minimum cut between outside and inside on the graph of cells (method 1.3).
//!
//! Incremental breadth-first search (Goldberg, Hed, Kaplan, Tarjan, Werneck: Maximum Flows by
//! Incremental Breadth-First Search, 2011): two trees of shortest residual paths grow level by
//! level, from the source and towards the sink. Where they meet, flow is pushed; orphaned nodes are
//! adopted by another parent at their level, or move to the lowest level with a parent, or become
//! free. Every cell has four outgoing and four incoming arcs, so that a node with its arcs is one
//! cache line; neither children nor current arcs are stored.
//!
//! Capacities are integers, so that the result is exact and deterministic. Worst case: n² m; in
//! practice a few scans per cell.

#[cfg(test)]
mod tests;

use std::ops::Range;

use super::delaunay::{Cell, Facet};
use crate::base::progress::{Cancelled, Watcher};
use bytemuck::Zeroable;

/// Upper limit of a facet's capacity: the residuals of two opposite arcs together fit 32 bits.
pub const MAX_CAPACITY: u32 = u32::MAX / 2;

/// Nodes visited between two checks for cancellation: a few milliseconds.
const STEPS_PER_CHECK: usize = 1 << 15;
/// Nodes made at a time.
const BLOCK: usize = 1 << 18;

/// The minimum cut; among several the one with the fewest cells outside.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MinCut {
    /// Its capacity.
    pub flow: u64,
    /// By cell: true on the source's side (outside).
    pub outside: Vec<bool>,
}

/// Capacities of one cell.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Capacities {
    /// To the cell beyond each facet; see [`MAX_CAPACITY`].
    pub facets: [u32; 4],
    /// From the source: evidence that the cell is outside.
    pub source: u32,
    /// To the sink: evidence that the cell is inside.
    pub sink: u32,
}

/// Finds the minimum cut; `capacities[i]` belongs to `cells[i]`. They are freed while the nodes of
/// the search are made.
///
/// # Errors
/// Cancellation.
///
/// # Panics
/// If the two slices differ in length.
pub fn minimum_cut(
    cells: &[Cell],
    capacities: Vec<Capacities>,
    watcher: &dyn Watcher,
) -> Result<MinCut, Cancelled> {
    assert_eq!(
        cells.len(),
        capacities.len(),
        "one set of capacities per cell"
    );
    let mut search = Search::new(cells, capacities, watcher)?;
    search.run()?;
    Ok(MinCut {
        flow: search.flow,
        outside: search.reachable()?,
    })
}

/// The two trees; also an index of the residuals along which the tree grows.
#[derive(Clone, Copy, PartialEq, Eq, Zeroable)]
#[repr(u8)]
enum SearchTree {
    Source,
    Sink,
    None,
}

use SearchTree::{Sink, Source};

impl SearchTree {
    fn other(self) -> SearchTree {
        if self == Source { Sink } else { Source }
    }
}

/// Parent slots beyond the four neighbours.
const ROOT: u8 = 4;
const ORPHAN: u8 = 5;

#[derive(Clone, Copy, Zeroable)]
#[repr(C, align(64))]
struct Node {
    /// `[Source]`: residual capacity to each neighbour; `[Sink]`: residual capacity from it.
    residual: [[u32; 4]; 2],
    neighbours: [Facet; 4],
    /// Residual capacity from the source; negative: to the sink.
    excess: i64,
    /// Number of arcs to the terminal.
    level: u32,
    tree: SearchTree,
    /// Slot of the parent, [`ROOT`] or [`ORPHAN`].
    parent: u8,
}

impl Node {
    /// A root of a tree, or free; residuals from neighbours are still missing.
    fn new(cell: &Cell, own: &Capacities) -> Self {
        let excess = i64::from(own.source) - i64::from(own.sink);
        let tree = match excess.signum() {
            1 => Source,
            -1 => Sink,
            _ => SearchTree::None,
        };
        let residual = [own.facets.map(|c| c.min(MAX_CAPACITY)), [0; 4]];
        Self {
            residual,
            neighbours: cell.neighbours,
            excess,
            level: 1,
            tree,
            parent: ROOT,
        }
    }
}

struct Search<'a> {
    watcher: &'a dyn Watcher,
    nodes: Vec<Node>,
    flow: u64,
    /// By tree: the nodes of the last complete level, and its number. Entries may be stale.
    frontier: [Vec<u32>; 2],
    level: [u32; 2],
    /// Nodes of the level that is growing.
    next: Vec<u32>,
    /// Orphans by level, lowest first.
    orphans: Vec<Vec<u32>>,
    orphan_count: usize,
    /// The tree that is growing.
    growing: SearchTree,
    /// Nodes visited since the last check for cancellation.
    steps: usize,
}

/// Returns the nodes of the cells, still without residuals from neighbours. Goes backwards, so that
/// the capacities of finished nodes can be freed: peak memory stays near that of the search itself.
fn nodes(
    cells: &[Cell],
    mut capacities: Vec<Capacities>,
    watcher: &dyn Watcher,
) -> Result<Vec<Node>, Cancelled> {
    // Zeroed pages take memory only when written, by which time capacities behind them are freed.
    let mut nodes: Vec<Node> = bytemuck::zeroed_vec(cells.len());
    for block in blocks(cells.len()).rev() {
        watcher.check()?;
        let inputs = cells[block.clone()].iter().zip(&capacities[block.clone()]);
        for (node, (cell, own)) in nodes[block.clone()].iter_mut().zip(inputs) {
            *node = Node::new(cell, own);
        }
        capacities.truncate(block.start);
        capacities.shrink_to_fit();
    }
    Ok(nodes)
}

/// Returns the parts of the nodes between two checks for cancellation.
fn blocks(nodes: usize) -> impl DoubleEndedIterator<Item = Range<usize>> {
    let starts = (0..nodes).step_by(BLOCK);
    starts.map(move |start| start..(start + BLOCK).min(nodes))
}

impl<'a> Search<'a> {
    fn new(
        cells: &[Cell],
        capacities: Vec<Capacities>,
        watcher: &'a dyn Watcher,
    ) -> Result<Self, Cancelled> {
        // What a cell takes straight from the source to the sink is flow at once; nodes begin with
        // the difference.
        let flow = capacities
            .iter()
            .map(|own| u64::from(own.source.min(own.sink)))
            .sum();
        let mut search = Search {
            watcher,
            nodes: nodes(cells, capacities, watcher)?,
            flow,
            frontier: [Vec::new(), Vec::new()],
            level: [1, 1],
            growing: Source,
            next: Vec::new(),
            orphans: Vec::new(),
            orphan_count: 0,
            steps: 0,
        };
        search.connect()?;
        Ok(search)
    }

    /// Sets the residuals from neighbours, and plants the trees.
    fn connect(&mut self) -> Result<(), Cancelled> {
        for block in blocks(self.nodes.len()) {
            self.watcher.check()?;
            for index in block {
                let node = &self.nodes[index];
                let (tree, neighbours) = (node.tree, node.neighbours);
                let from =
                    |f: Facet| self.nodes[f.cell() as usize].residual[Source as usize][f.index()];
                self.nodes[index].residual[Sink as usize] = neighbours.map(from);
                if tree != SearchTree::None {
                    self.frontier[tree as usize].push(index as u32);
                }
            }
        }
        Ok(())
    }

    /// Counts work, and regularly checks for cancellation.
    fn step(&mut self) -> Result<(), Cancelled> {
        self.steps += 1;
        if self.steps < STEPS_PER_CHECK {
            return Ok(());
        }
        self.steps = 0;
        self.watcher.check()
    }

    /// Grows the tree with the shorter frontier until one cannot grow.
    fn run(&mut self) -> Result<(), Cancelled> {
        while !self.frontier[0].is_empty() && !self.frontier[1].is_empty() {
            let tree = if self.frontier[0].len() <= self.frontier[1].len() {
                Source
            } else {
                Sink
            };
            self.growing = tree;
            let frontier = std::mem::take(&mut self.frontier[tree as usize]);
            self.level[tree as usize] += 1;
            for &node in &frontier {
                self.step()?;
                self.scan(node, tree)?;
            }
            self.frontier[tree as usize] = std::mem::replace(&mut self.next, frontier);
            self.next.clear();
        }
        Ok(())
    }

    /// Adds the free neighbours of a frontier node to its tree and pushes flow over arcs to the
    /// other tree.
    fn scan(&mut self, index: u32, tree: SearchTree) -> Result<(), Cancelled> {
        let level = self.level[tree as usize];
        let mut slot = 0;
        while slot < 4 {
            let node = &self.nodes[index as usize];
            // Augmenting an earlier arc may have freed the node or moved it to another level.
            if node.tree != tree || node.level + 1 != level {
                break;
            }
            let beyond = node.neighbours[slot];
            if node.residual[tree as usize][slot] == 0 {
                slot += 1;
                continue;
            }
            let other = &mut self.nodes[beyond.cell() as usize];
            if other.tree == tree.other() {
                // The same arc again: it may have capacity left.
                self.augment(Facet::new(index, slot), tree)?;
                continue;
            }
            if other.tree == SearchTree::None {
                other.tree = tree;
                other.level = level;
                other.parent = beyond.index() as u8;
                self.next.push(beyond.cell());
            }
            slot += 1;
        }
        Ok(())
    }

    /// Saturates the path through an arc between the trees; `arc` as seen from its end in `tree`.
    fn augment(&mut self, arc: Facet, tree: SearchTree) -> Result<(), Cancelled> {
        let beyond = self.nodes[arc.cell() as usize].neighbours[arc.index()];
        let amount = self.nodes[arc.cell() as usize].residual[tree as usize][arc.index()]
            .min(self.bottleneck(arc.cell()))
            .min(self.bottleneck(beyond.cell()));
        self.push(arc, tree, amount);
        self.flow += u64::from(amount);
        self.push_to_root(arc.cell(), tree, amount);
        self.adopt(tree)?;
        self.push_to_root(beyond.cell(), tree.other(), amount);
        self.adopt(tree.other())
    }

    /// Returns the smallest residual between a node and its terminal.
    fn bottleneck(&self, mut index: u32) -> u32 {
        let mut least = u32::MAX;
        loop {
            let node = &self.nodes[index as usize];
            if node.parent == ROOT {
                return least.min(u32::try_from(node.excess.unsigned_abs()).unwrap_or(u32::MAX));
            }
            let parent = usize::from(node.parent);
            least = least.min(node.residual[node.tree.other() as usize][parent]);
            index = node.neighbours[parent].cell();
        }
    }

    /// Pushes flow over an arc in the direction of `along`.
    fn push(&mut self, arc: Facet, along: SearchTree, amount: u32) {
        // Both ends keep the arc's residuals, so that a scan reads its own node alone.
        let (there, back) = (along as usize, along.other() as usize);
        let node = &mut self.nodes[arc.cell() as usize];
        node.residual[there][arc.index()] -= amount;
        node.residual[back][arc.index()] += amount;
        let beyond = node.neighbours[arc.index()];
        let other = &mut self.nodes[beyond.cell() as usize];
        other.residual[back][beyond.index()] -= amount;
        other.residual[there][beyond.index()] += amount;
    }

    /// Pushes flow over the tree's arcs between a node and the terminal; disconnected nodes become
    /// orphans.
    fn push_to_root(&mut self, mut index: u32, tree: SearchTree, amount: u32) {
        loop {
            self.steps += 1;
            let node = &mut self.nodes[index as usize];
            if node.parent == ROOT {
                node.excess -= if tree == Source {
                    i64::from(amount)
                } else {
                    -i64::from(amount)
                };
                if node.excess == 0 {
                    self.make_orphan(index);
                }
                return;
            }
            let arc = Facet::new(index, usize::from(node.parent));
            let parent = node.neighbours[arc.index()].cell();
            let saturated = node.residual[tree.other() as usize][arc.index()] == amount;
            self.push(arc, tree.other(), amount);
            if saturated {
                self.make_orphan(index);
            }
            index = parent;
        }
    }

    fn make_orphan(&mut self, index: u32) {
        let node = &mut self.nodes[index as usize];
        node.parent = ORPHAN;
        let level = node.level as usize;
        if self.orphans.len() <= level {
            self.orphans.resize(level + 1, Vec::new());
        }
        self.orphans[level].push(index);
        self.orphan_count += 1;
    }

    /// Adopts all orphans, those nearest to the terminal first.
    fn adopt(&mut self, tree: SearchTree) -> Result<(), Cancelled> {
        let mut level = 1;
        while self.orphan_count > 0 {
            while let Some(index) = self.orphans[level].pop() {
                self.orphan_count -= 1;
                self.step()?;
                self.find_parent(index, tree);
            }
            level += 1;
        }
        Ok(())
    }

    fn find_parent(&mut self, index: u32, tree: SearchTree) {
        let node = self.nodes[index as usize];
        let (below, parent) = self.lowest_neighbour(&node, tree);
        if below + 1 != node.level || parent == ORPHAN {
            self.orphan_children(&node);
        }
        let node = &mut self.nodes[index as usize];
        node.parent = parent;
        if parent == ORPHAN {
            node.tree = SearchTree::None;
        } else if below + 1 > node.level {
            node.level = below + 1;
            if node.level == self.level[tree as usize] {
                let unscanned = if tree == self.growing {
                    &mut self.next
                } else {
                    &mut self.frontier[tree as usize]
                };
                unscanned.push(index);
            }
        }
    }

    /// Returns level and slot of the neighbour nearest to the terminal that can be a node's parent;
    /// [`ORPHAN`] if none can.
    fn lowest_neighbour(&self, node: &Node, tree: SearchTree) -> (u32, u8) {
        let mut lowest = (self.level[tree as usize], ORPHAN);
        for (slot, beyond) in node.neighbours.into_iter().enumerate() {
            if node.residual[tree.other() as usize][slot] == 0 {
                continue;
            }
            let other = &self.nodes[beyond.cell() as usize];
            if other.tree == tree && other.level < lowest.0 {
                lowest = (other.level, slot as u8);
                // Levels never fall, so that no neighbour is nearer than this one.
                if other.level + 1 == node.level {
                    break;
                }
            }
        }
        lowest
    }

    fn orphan_children(&mut self, node: &Node) {
        for beyond in node.neighbours {
            let other = &self.nodes[beyond.cell() as usize];
            if other.tree == node.tree && usize::from(other.parent) == beyond.index() {
                self.make_orphan(beyond.cell());
            }
        }
    }

    /// Returns the cells that are reachable from the source in the residual graph.
    fn reachable(&mut self) -> Result<Vec<bool>, Cancelled> {
        let mut outside: Vec<bool> = self.nodes.iter().map(|node| node.excess > 0).collect();
        let mut open: Vec<u32> = (0..self.nodes.len() as u32)
            .filter(|&i| outside[i as usize])
            .collect();
        while let Some(index) = open.pop() {
            self.step()?;
            let node = &self.nodes[index as usize];
            for (slot, beyond) in node.neighbours.into_iter().enumerate() {
                let other = beyond.cell();
                if node.residual[Source as usize][slot] > 0 && !outside[other as usize] {
                    outside[other as usize] = true;
                    open.push(other);
                }
            }
        }
        Ok(outside)
    }
}
