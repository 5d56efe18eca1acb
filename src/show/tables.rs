//! The tables of a plan as NumPy files (method 6), to recompute, check or plot results.

use serde_json::json;

use crate::{
    base::rows::Offsets,
    io::{
        npy,
        output::{Contents, FileSet},
    },
    method::confidence::Confidence,
    model::scene::ViewIndex,
    plan::Plan,
};

/// Adds the tables of method 6 to a set of files.
pub fn add(plan: &Plan, files: &mut FileSet) {
    let mut table = |name: &str, bytes: Vec<u8>| add_table(files, name, bytes);
    let vertices: Vec<f64> = plan
        .stages
        .surface
        .vertices
        .iter()
        .flat_map(|v| v.coords.iter().copied())
        .collect();
    table(
        "vertices",
        npy::write(&[plan.stages.surface.vertices.len(), 3], vertices),
    );
    table(
        "triangles",
        npy::write(
            &[plan.stages.surface.triangles.len(), 3],
            plan.stages.surface.triangles.iter().flatten().copied(),
        ),
    );
    table(
        "triangle_gsd",
        npy::write(
            &[plan.stages.target.gsd.len()],
            plan.stages.target.gsd.iter().copied(),
        ),
    );
    table(
        "weight",
        npy::write(
            &[plan.stages.objective.weights.len()],
            plan.stages.objective.weights.iter().copied(),
        ),
    );
    let visible = rows(
        plan.stages.visibility.offsets.as_slice(),
        &plan.stages.visibility.triangles,
    );
    table(
        "visible",
        npy::write(&[plan.stages.visibility.triangles.len(), 2], visible),
    );
    let (unary, seen) = (&plan.stages.unary, plan.stages.visibility.triangles.len());
    table(
        "unary",
        npy::write(&[seen], (0..seen).map(|row| unary.at(row).observed)),
    );
    table(
        "allowed",
        npy::write(&[seen], (0..seen).map(|row| unary.at(row).allowed)),
    );
    if let Confidence::Photometric { .. } = plan.stages.rule.confidence {
        let agreement = &plan.stages.agreement;
        table("agreement_partners", indices(&agreement.partners));
        table("agreement_offsets", offsets(&agreement.offsets));
        table(
            "agreement",
            npy::write(&[agreement.values.len()], agreement.values.iter().copied()),
        );
    }
    table("candidates", indices(&plan.stages.candidates.views));
    table(
        "candidate_offsets",
        offsets(plan.stages.candidates.offsets.as_slice()),
    );
    let partners: Vec<ViewIndex> = plan
        .stages
        .clusters
        .iter()
        .flat_map(|c| c.partners.iter().copied())
        .collect();
    let partner_offsets =
        Offsets::from_lengths(plan.stages.clusters.iter().map(|c| c.partners.len()));
    table("partners", indices(&partners));
    table("partner_offsets", offsets(partner_offsets.as_slice()));
    table(
        "cluster_key",
        indices(
            &plan
                .stages
                .clusters
                .iter()
                .map(|c| c.key)
                .collect::<Vec<_>>(),
        ),
    );
    let fulfilment = rows(
        &plan.stages.fulfilment.offsets,
        &plan.stages.fulfilment.triangles,
    );
    table(
        "fulfilment",
        npy::write(&[plan.stages.fulfilment.triangles.len(), 2], fulfilment),
    );
    table(
        "fulfilment_value",
        npy::write(
            &[plan.stages.fulfilment.values.len()],
            plan.stages.fulfilment.values.iter().copied(),
        ),
    );
    table(
        "order",
        npy::write(
            &[plan.decision.ranking.order.len()],
            plan.decision.ranking.order.iter().copied(),
        ),
    );
    table(
        "gain",
        npy::write(
            &[plan.decision.ranking.gains.len()],
            plan.decision.ranking.gains.iter().copied(),
        ),
    );
    add_json(plan, files);
}

fn add_json(plan: &Plan, files: &mut FileSet) {
    let view = |v: ViewIndex| {
        let view = plan.stages.scene.view(v);
        json!({
            "index": v.0,
            "name": view.name,
            "image_id": view.image_id,
            "camera_id": plan.stages.scene.camera_of(v).id,
        })
    };
    let views: Vec<_> = plan.stages.scene.view_indices().map(view).collect();
    files.add_text("views.json", format!("{:#}\n", json!(views)));
    let mut settings = serde_json::to_value(&plan.stages.settings).expect("settings are JSON");
    // f also depends on these, which the settings may leave to the data and the backend.
    settings["in_force"] = json!({
        "backend": plan.stages.backend,
        "accuracy_over_gsd": plan.stages.target.accuracy_over_gsd,
    });
    files.add_text("settings.json", format!("{settings:#}\n"));
}

/// Adds one table.
pub(crate) fn add_table(files: &mut FileSet, name: &str, bytes: Vec<u8>) {
    files.add(format!("{name}.npy"), Contents::Bytes(bytes));
}

/// Returns the (row, column) pairs of all entries of a CSR table, flattened.
pub(crate) fn rows<'a>(offsets: &'a [usize], columns: &'a [u32]) -> impl Iterator<Item = u32> + 'a {
    let of_row = |row: usize| {
        columns[offsets[row]..offsets[row + 1]]
            .iter()
            .flat_map(move |&column| [row as u32, column])
    };
    (0..offsets.len().saturating_sub(1)).flat_map(of_row)
}

pub(crate) fn indices(views: &[ViewIndex]) -> Vec<u8> {
    npy::write(&[views.len()], views.iter().map(|v| v.0))
}

pub(crate) fn offsets(offsets: &[usize]) -> Vec<u8> {
    npy::write(&[offsets.len()], offsets.iter().map(|&o| o as u64))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_of_a_table_are_numbered() {
        assert_eq!(
            rows(&[0, 2, 2, 3], &[7, 9, 4]).collect::<Vec<_>>(),
            [0, 7, 0, 9, 2, 4]
        );
    }
}
