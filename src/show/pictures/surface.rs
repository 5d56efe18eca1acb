//! `surface.ply`: the surface with scalar fields per triangle (for MeshLab) and per vertex (for
//! CloudCompare).

use crate::{
    base::column,
    io::ply::{self, FaceField},
    method::ranking::Reached,
    model::reason::Reason,
    plan::Plan,
};

/// Fulfilment of a triangle by the chosen clusters.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TriangleState {
    /// Fulfilment by the chosen clusters (method 5.2).
    pub fulfilment: f32,
    /// Fulfilment by all clusters together.
    pub reachable: f32,
    /// Chosen key views that fulfil it at all.
    pub chosen_views: u16,
}

impl TriangleState {
    /// Share of the reachable fulfilment that is reached, 0 to 1; 0 if nothing is reachable.
    pub fn share(&self) -> f32 {
        if self.reachable > 0.0 {
            self.fulfilment / self.reachable
        } else {
            0.0
        }
    }
}

/// Returns the state of every triangle after the first `clusters` of the ranking.
pub fn triangle_states(plan: &Plan, clusters: usize) -> Vec<TriangleState> {
    let mut states = vec![TriangleState::default(); plan.stages.surface.triangles.len()];
    for_each_step(plan, |rank, triangle, fulfilment| {
        let state = &mut states[triangle as usize];
        state.reachable = fulfilment;
        if rank < clusters {
            state.fulfilment = fulfilment;
            state.chosen_views = state.chosen_views.saturating_add(1);
        }
    });
    states
}

/// Calls `visit` along the ranking for each cluster and each triangle that it fulfils at all, with
/// the rank (from 0), the triangle, and its fulfilment by the clusters up to this one (method 5.2).
pub fn for_each_step(plan: &Plan, mut visit: impl FnMut(usize, u32, f32)) {
    let mut reached = Reached::new(&plan.stages.objective);
    let maps = plan.stages.maps();
    for (rank, (cluster, scale)) in plan.decision.ranking.maps().enumerate() {
        // Pages of a table on disk would otherwise stay in memory, one after the other.
        if rank.is_multiple_of(column::READ_AT_ONCE) {
            maps.release();
        }
        let (of_cluster, values) = maps.row_at(cluster, scale);
        for (&t, &f) in of_cluster.iter().zip(values) {
            reached.take_at(t, f);
            visit(rank, t, reached.worth(t));
        }
    }
}

/// Colours of a share of 0, 1/2 and 1, pale yellow through green to dark blue: ever darker,
/// distinguishable by the colour-blind and in greyscale.
pub const RAMP: [[u8; 3]; 3] = [[250, 226, 158], [96, 160, 152], [16, 80, 136]];

/// Returns the surface at the plan's cut as PLY: `quality` (share reached), `chosen_views`,
/// `reason`, and colours from pale yellow (nothing) through green to dark blue (all that can be
/// reached); red where no view can do anything. With a region, also `region`, the factor on each
/// triangle's weight; colours outside are pale.
pub fn surface_ply(plan: &Plan) -> Vec<u8> {
    let states = triangle_states(plan, plan.decision.cut.clusters);
    let share: Vec<f32> = states.iter().map(TriangleState::share).collect();
    let chosen: Vec<f32> = states.iter().map(|s| f32::from(s.chosen_views)).collect();
    let reasons: Vec<u8> = plan
        .decision
        .triangle_reasons
        .iter()
        .map(|&reason| Reason::number(reason))
        .collect();
    let mut colours: Vec<[u8; 3]> = states.iter().map(colour).collect();
    let region = plan.stages.region.as_ref();
    if let Some(region) = region {
        (0..)
            .zip(&mut colours)
            .filter(|(t, _)| !region.is_inside(*t))
            .for_each(|(_, colour)| *colour = pale(*colour));
    }
    let mut fields = vec![
        FaceField::Colour(&colours),
        FaceField::Float("quality", &share),
        FaceField::Float("chosen_views", &chosen),
        FaceField::Byte("reason", &reasons),
    ];
    fields.extend(region.map(|region| FaceField::Float("region", &region.factors)));
    let mut comments = vec![
        "quality: share of the reachable fulfilment that is reached at the cut".to_string(),
        "chosen_views: chosen key views that fulfil the triangle".to_string(),
        "reason: why no cluster fulfils the triangle to a tenth; 0: one does".to_string(),
    ];
    comments.extend(
        region.map(|_| "region: factor on the weight of the triangle; 0 outside".to_string()),
    );
    comments.extend(
        Reason::NUMBERED
            .iter()
            .enumerate()
            .map(|(i, r)| format!("reason {}: {}", i + 1, word(*r))),
    );
    ply::write(
        &plan.stages.surface.vertices,
        &plan.stages.surface.triangles,
        &fields,
        &comments,
    )
}

/// Returns the reason as written in the manifest.
fn word(reason: Reason) -> String {
    serde_json::to_value(reason)
        .ok()
        .and_then(|v| v.as_str().map(str::to_owned))
        .unwrap_or_default()
}

/// Returns the paler colour that is used outside the region.
fn pale(colour: [u8; 3]) -> [u8; 3] {
    colour.map(|channel| (u16::from(channel) / 4 + 168) as u8)
}

/// [`RAMP`] interpolated at the share reached; red if nothing is reachable.
pub(super) fn colour(state: &TriangleState) -> [u8; 3] {
    if state.reachable <= 0.0 {
        return [190, 66, 40];
    }
    let share = state.share().clamp(0.0, 1.0) * 2.0;
    let (from, to, t) = if share < 1.0 {
        (RAMP[0], RAMP[1], share)
    } else {
        (RAMP[1], RAMP[2], share - 1.0)
    };
    std::array::from_fn(|i| {
        (f32::from(from[i]) + t * (f32::from(to[i]) - f32::from(from[i]))).round() as u8
    })
}
