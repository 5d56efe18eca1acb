//! Cleans the raw surface (method 1.4) and repairs it to an oriented manifold with borders.

use crate::{
    base::connected::components,
    model::surface::{
        Surface,
        corners::{BORDER, opposites, split_fans},
    },
};

/// Limit on edges, as a multiple of their 95th percentile: facets with longer edges span gaps
/// without points and are mostly wrong (`benches/surface_truth.rs`). At 8 and below, visible parts
/// of the true surface are lost too; above 25, hardly any facet is removed.
const LONG_EDGE_FACTOR: f64 = 10.0;
/// Components with a smaller share of the area and fewer than [`SMALL_COMPONENT_TRIANGLES`] are
/// removed.
const SMALL_COMPONENT_AREA: f64 = 0.001;
const SMALL_COMPONENT_TRIANGLES: usize = 100;

/// Drops facets that are not `seen` or too long, repairs the rest to an oriented manifold and drops
/// small components.
pub fn clean(surface: &Surface, seen: &[bool]) -> Surface {
    let limit = edge_percentile(surface, seen, 0.95).map_or(0.0, |p| LONG_EDGE_FACTOR * p);
    // The cut also closes the surface underneath and around the scene, where no ray arrives.
    let is_kept = |t: usize| seen[t] && longest_edge(surface, t as u32) <= limit;
    let keep: Vec<bool> = (0..seen.len()).map(is_kept).collect();
    drop_small_components(&surface.keep(&keep))
}

/// Repairs facets to an oriented manifold with borders: drops facets that repeat a vertex or
/// another facet, splits edges with more than two facets and vertices with more than one fan.
pub fn make_manifold(mut surface: Surface) -> Surface {
    surface
        .triangles
        .retain(|&[a, b, c]| a != b && b != c && c != a);
    drop_repeated(&mut surface.triangles);
    split_fans(surface)
}

/// Drops triangles with the same three vertices as an earlier one, in any orientation.
fn drop_repeated(triangles: &mut Vec<[u32; 3]>) {
    let sorted = |t: [u32; 3]| {
        let mut t = t;
        t.sort_unstable();
        t
    };
    let mut order: Vec<([u32; 3], u32)> = triangles
        .iter()
        .enumerate()
        .map(|(i, &t)| (sorted(t), i as u32))
        .collect();
    order.sort_unstable();
    let repeated: Vec<u32> = order
        .windows(2)
        .filter(|w| w[0].0 == w[1].0)
        .map(|w| w[1].1)
        .collect();
    if repeated.is_empty() {
        return;
    }
    let mut keep = vec![true; triangles.len()];
    repeated.iter().for_each(|&t| keep[t as usize] = false);
    let mut kept = keep.iter();
    triangles.retain(|_| *kept.next().expect("one flag per triangle"));
}

fn longest_edge(surface: &Surface, triangle: u32) -> f64 {
    surface.sides(triangle).into_iter().fold(0.0, f64::max)
}

/// Returns a percentile (0 to 1) of the edge lengths of the triangles for which `counts`; `None`
/// without triangles.
fn edge_percentile(surface: &Surface, counts: &[bool], share: f64) -> Option<f64> {
    let mut lengths: Vec<f64> = (0..counts.len())
        .filter(|&t| counts[t])
        .flat_map(|t| surface.sides(t as u32))
        .collect();
    let rank = ((lengths.len() as f64 * share) as usize).min(lengths.len().checked_sub(1)?);
    Some(*lengths.select_nth_unstable_by(rank, f64::total_cmp).1)
}

/// Drops components (triangles joined by edges) with under 0.1 % of the area and fewer than 100
/// triangles. The surface must be manifold.
fn drop_small_components(surface: &Surface) -> Surface {
    let opposite = opposites(surface);
    let beside = |t: u32| {
        opposite[3 * t as usize..][..3]
            .iter()
            .filter(|&&c| c != BORDER)
            .map(|c| c / 3)
    };
    let components = components(surface.triangles.len(), beside);
    let areas: Vec<f64> = components
        .iter()
        .map(|c| c.iter().map(|&t| surface.area(t)).sum())
        .collect();
    let least = SMALL_COMPONENT_AREA * areas.iter().sum::<f64>();
    let mut keep = vec![false; surface.triangles.len()];
    for (component, area) in components.iter().zip(areas) {
        if area >= least || component.len() >= SMALL_COMPONENT_TRIANGLES {
            component.iter().for_each(|&t| keep[t as usize] = true);
        }
    }
    surface.keep(&keep)
}
