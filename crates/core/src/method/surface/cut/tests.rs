use super::*;
use crate::base::progress::{NoWatcher, Stage};
use crate::method::surface::delaunay::Delaunay;
use nalgebra::Point3;
use proptest::prelude::*;
use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::collections::VecDeque;
use std::sync::atomic::{AtomicU32, Ordering};

/// Cells of random points with random capacities: `density` of a hundred cells have evidence of
/// either kind, facets up to `widest`.
fn instance(points: usize, density: u64, widest: u64, seed: u64) -> (Vec<Cell>, Vec<Capacities>) {
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    let mut below = |bound: u64| random.next_u64() % bound;
    let points: Vec<_> = (0..points)
        .map(|_| Point3::from([(); 3].map(|()| below(1 << 20) as f64)))
        .collect();
    let cells = Delaunay::triangulate(&points, &NoWatcher)
        .expect("random points")
        .cells;
    let capacities = cells
        .iter()
        .map(|_| Capacities {
            facets: [(); 4].map(|()| below(widest + 1) as u32),
            source: if below(100) < density {
                below(1000) as u32
            } else {
                0
            },
            sink: if below(100) < density {
                below(1000) as u32
            } else {
                0
            },
        })
        .collect();
    (cells, capacities)
}

fn found(cells: &[Cell], capacities: &[Capacities]) -> MinCut {
    minimum_cut(cells, capacities.to_vec(), &NoWatcher).expect("not cancelled")
}

/// Dinic's algorithm on a list of arcs with explicit terminals: slow and plain.
struct Dinic {
    /// Head and residual; arc i and i ^ 1 are each other's reverse.
    arcs: Vec<(usize, u64)>,
    out: Vec<Vec<usize>>,
}

impl Dinic {
    fn new(cells: &[Cell], capacities: &[Capacities]) -> Self {
        let mut graph = Dinic {
            arcs: Vec::new(),
            out: vec![Vec::new(); cells.len() + 2],
        };
        let (source, sink) = (cells.len(), cells.len() + 1);
        for (index, (cell, own)) in cells.iter().zip(capacities).enumerate() {
            graph.join(source, index, own.source);
            graph.join(index, sink, own.sink);
            for (slot, beyond) in cell.neighbours.into_iter().enumerate() {
                graph.join(index, beyond.cell() as usize, own.facets[slot]);
            }
        }
        graph
    }

    fn join(&mut self, from: usize, to: usize, capacity: u32) {
        for (tail, head, residual) in [(from, to, u64::from(capacity)), (to, from, 0)] {
            self.out[tail].push(self.arcs.len());
            self.arcs.push((head, residual));
        }
    }

    fn levels(&self, source: usize) -> Vec<usize> {
        let mut levels = vec![usize::MAX; self.out.len()];
        levels[source] = 0;
        let mut open = VecDeque::from([source]);
        while let Some(node) = open.pop_front() {
            for &arc in &self.out[node] {
                let (head, residual) = self.arcs[arc];
                if residual > 0 && levels[head] == usize::MAX {
                    levels[head] = levels[node] + 1;
                    open.push_back(head);
                }
            }
        }
        levels
    }

    fn push(
        &mut self,
        node: usize,
        sink: usize,
        amount: u64,
        levels: &[usize],
        next: &mut [usize],
    ) -> u64 {
        if node == sink {
            return amount;
        }
        while next[node] < self.out[node].len() {
            let arc = self.out[node][next[node]];
            let (head, residual) = self.arcs[arc];
            if residual > 0 && levels[head] == levels[node] + 1 {
                let pushed = self.push(head, sink, amount.min(residual), levels, next);
                if pushed > 0 {
                    self.arcs[arc].1 -= pushed;
                    self.arcs[arc ^ 1].1 += pushed;
                    return pushed;
                }
            }
            next[node] += 1;
        }
        0
    }

    fn cut(mut self) -> MinCut {
        let (source, sink) = (self.out.len() - 2, self.out.len() - 1);
        let mut flow = 0;
        loop {
            let levels = self.levels(source);
            if levels[sink] == usize::MAX {
                return MinCut {
                    flow,
                    outside: levels[..source]
                        .iter()
                        .map(|&level| level != usize::MAX)
                        .collect(),
                };
            }
            let mut next = vec![0; self.out.len()];
            while let pushed @ 1.. = self.push(source, sink, u64::MAX, &levels, &mut next) {
                flow += pushed;
            }
        }
    }
}

/// Returns the capacity of the cut with these cells outside.
fn cost(cells: &[Cell], capacities: &[Capacities], outside: &[bool]) -> u64 {
    let mut sum = 0;
    for (index, own) in capacities.iter().enumerate() {
        if !outside[index] {
            sum += u64::from(own.source);
            continue;
        }
        sum += u64::from(own.sink);
        for (slot, beyond) in cells[index].neighbours.into_iter().enumerate() {
            if !outside[beyond.cell() as usize] {
                sum += u64::from(own.facets[slot]);
            }
        }
    }
    sum
}

#[test]
fn agrees_with_dinic() {
    for (seed, (density, widest)) in [(100, 50), (30, 300), (5, 1000), (1, 20), (50, 0), (2, 5)]
        .into_iter()
        .enumerate()
    {
        let (cells, capacities) = instance(600, density, widest, seed as u64);
        let cut = found(&cells, &capacities);
        assert_eq!(
            cut,
            Dinic::new(&cells, &capacities).cut(),
            "density {density}, widest {widest}"
        );
        assert_eq!(cost(&cells, &capacities, &cut.outside), cut.flow);
    }
}

/// Checks conservation of flow in each cell, capacities, and agreement of both ends of each arc.
#[test]
fn flow_is_conserved() {
    let (cells, capacities) = instance(400, 20, 200, 9);
    let mut search = Search::new(&cells, capacities.clone(), &NoWatcher).expect("not cancelled");
    search.run().expect("not cancelled");
    let mut terminals = 0;
    for (node, own) in search.nodes.iter().zip(&capacities) {
        let sent: i64 = (0..4)
            .map(|i| i64::from(own.facets[i]) - i64::from(node.residual[0][i]))
            .sum();
        let given = i64::from(own.source) - i64::from(own.sink) - node.excess;
        assert_eq!(sent, given);
        assert!(
            given == 0 || (own.source > own.sink) == (given > 0),
            "flow out of a sink or into a source"
        );
        terminals += given.max(0) as u64 + u64::from(own.source.min(own.sink));
        for (slot, beyond) in node.neighbours.into_iter().enumerate() {
            let other = &search.nodes[beyond.cell() as usize];
            assert_eq!(node.residual[0][slot], other.residual[1][beyond.index()]);
            let both = own.facets[slot] + capacities[beyond.cell() as usize].facets[beyond.index()];
            assert_eq!(node.residual[0][slot] + node.residual[1][slot], both);
        }
    }
    assert_eq!(terminals, search.flow);
}

#[test]
fn no_evidence_leaves_everything_inside() {
    let (cells, mut capacities) = instance(50, 0, 10, 1);
    assert_eq!(
        found(&cells, &capacities),
        MinCut {
            flow: 0,
            outside: vec![false; cells.len()]
        }
    );
    capacities[3].source = 5;
    let cut = found(&cells, &capacities);
    assert_eq!((cut.flow, cut.outside[3]), (0, true));
    assert_eq!(
        found(&[], &[]),
        MinCut {
            flow: 0,
            outside: vec![]
        }
    );
}

/// The largest capacities neither overflow nor lose anything.
#[test]
fn largest_capacities() {
    let (cells, mut capacities) = instance(30, 0, 0, 2);
    for (index, own) in capacities.iter_mut().enumerate() {
        own.facets = [u32::MAX; 4];
        *(if index % 2 == 0 {
            &mut own.source
        } else {
            &mut own.sink
        }) = u32::MAX;
    }
    let mut clamped = capacities.clone();
    clamped
        .iter_mut()
        .for_each(|own| own.facets = [MAX_CAPACITY; 4]);
    assert_eq!(
        found(&cells, &capacities),
        Dinic::new(&cells, &clamped).cut()
    );
}

struct CancelAfter(AtomicU32);

impl Watcher for CancelAfter {
    fn progress(&self, _: Stage, _: u64, _: u64) {}

    fn cancelled(&self) -> bool {
        self.0.fetch_sub(1, Ordering::Relaxed) <= 1
    }
}

#[test]
fn can_be_cancelled() {
    let (cells, capacities) = instance(8000, 30, 300, 3);
    for questions in [1, 2, 3] {
        assert_eq!(
            minimum_cut(
                &cells,
                capacities.clone(),
                &CancelAfter(AtomicU32::new(questions))
            ),
            Err(Cancelled)
        );
    }
}

proptest! {
    #[test]
    fn agrees_with_dinic_anywhere(points in 5..60usize, density in 0..100u64, widest in 0..2000u64, seed in any::<u64>()) {
        let (cells, capacities) = instance(points, density, widest, seed);
        prop_assert_eq!(found(&cells, &capacities), Dinic::new(&cells, &capacities).cut());
    }
}
