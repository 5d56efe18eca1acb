//! The tables of a plan as NumPy files (method 6), to recompute, check or plot results.

use serde_json::json;

use crate::{
    base::rows::Offsets,
    decision::Tables,
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
    let tables = &plan.stages.tables;
    add_surface(tables, files);
    add_visibility(tables, files);
    add_clusters(tables, files);
    add_table(files, "order", list(&plan.decision.ranking.order));
    add_table(files, "gain", list(&plan.decision.ranking.gains));
    add_json(plan, files);
}

fn add_surface(tables: &Tables, files: &mut FileSet) {
    let surface = &tables.surface;
    let vertices = surface
        .vertices
        .iter()
        .flat_map(|v| v.coords.iter().copied());
    let vertices = npy::write(&[surface.vertices.len(), 3], vertices);
    add_table(files, "vertices", vertices);
    let corners = surface.triangles.iter().flatten().copied();
    let triangles = npy::write(&[surface.triangles.len(), 3], corners);
    add_table(files, "triangles", triangles);
    add_table(files, "triangle_gsd", list(&tables.target.gsd));
    add_table(files, "weight", list(&tables.objective.weights));
}

/// Adds what is known of each triangle in each view that sees it, and of its partners.
fn add_visibility(tables: &Tables, files: &mut FileSet) {
    let (seen, views) = (&tables.visibility.triangles, &tables.visibility.offsets);
    add_table(files, "visible", pairs(views.as_slice(), seen));
    let confidence = || (0..seen.len()).map(|row| tables.unary.at(row));
    let observed = npy::write(&[seen.len()], confidence().map(|at| at.observed));
    add_table(files, "unary", observed);
    let allowed = npy::write(&[seen.len()], confidence().map(|at| at.allowed));
    add_table(files, "allowed", allowed);
    if let Confidence::Photometric { .. } = tables.rule.confidence {
        let agreement = &tables.agreement;
        add_table(files, "agreement_partners", indices(&agreement.partners));
        add_table(files, "agreement_offsets", offsets(&agreement.offsets));
        add_table(files, "agreement", list(&agreement.values));
    }
    let candidates = &tables.candidates;
    add_table(files, "candidates", indices(&candidates.views));
    let of_views = offsets(candidates.offsets.as_slice());
    add_table(files, "candidate_offsets", of_views);
}

fn add_clusters(tables: &Tables, files: &mut FileSet) {
    let clusters = &tables.clusters;
    let partners: Vec<ViewIndex> = clusters.iter().flat_map(|c| c.partners.clone()).collect();
    let of_clusters = Offsets::from_lengths(clusters.iter().map(|c| c.partners.len()));
    let keys: Vec<ViewIndex> = clusters.iter().map(|c| c.key).collect();
    add_table(files, "partners", indices(&partners));
    add_table(files, "partner_offsets", offsets(of_clusters.as_slice()));
    add_table(files, "cluster_key", indices(&keys));
    let fulfilment = &tables.fulfilment;
    let triangles = pairs(&fulfilment.offsets, &fulfilment.triangles);
    add_table(files, "fulfilment", triangles);
    add_table(files, "fulfilment_value", list(&fulfilment.values));
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

pub(crate) fn list<T: npy::Value + Copy>(values: &[T]) -> Vec<u8> {
    npy::write(&[values.len()], values.iter().copied())
}

/// Returns the (row, column) pairs of all entries of a CSR table.
pub(crate) fn pairs(offsets: &[usize], columns: &[u32]) -> Vec<u8> {
    npy::write(&[columns.len(), 2], rows(offsets, columns))
}

/// Returns the pairs, flattened.
fn rows<'a>(offsets: &'a [usize], columns: &'a [u32]) -> impl Iterator<Item = u32> + 'a {
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
