//! Real fulfilment as NumPy files beside the plan's tables (method 6).

use super::run::MeasuredClusters;
use crate::{
    io::output::FileSet,
    plan::Plan,
    show::tables::{self, add_table, indices, list, offsets, pairs},
};

/// Adds the plan's tables and, for the clusters that were measured: `real.npy` (row, triangle) with
/// `real_value.npy`, where the row's key view is `real_key.npy` and the partners that were really
/// matched are `real_partners.npy`, `real_partner_offsets.npy` (CSR); `real_order.npy`: rows in the
/// order of the clusters; the same rows as predicted (`real_predicted*.npy`), as predicted with
/// f_conf = 1 (`real_nocp*.npy`), and as they would be if every pixel were right
/// (`real_attainable*.npy`).
pub fn add(plan: &Plan, run: &MeasuredClusters, files: &mut FileSet) {
    tables::add(plan, files);
    let partners: Vec<_> = run
        .matched
        .iter()
        .flat_map(|c| c.partners.iter().copied())
        .collect();
    let ends = run.matched.iter().scan(0, |sum, c| {
        *sum += c.partners.len();
        Some(*sum)
    });
    let mut table = |name: &str, bytes: Vec<u8>| add_table(files, name, bytes);
    table(
        "real_key",
        indices(&run.clusters.iter().map(|c| c.key).collect::<Vec<_>>()),
    );
    table("real_partners", indices(&partners));
    table(
        "real_partner_offsets",
        offsets(&std::iter::once(0).chain(ends).collect::<Vec<usize>>()),
    );
    table("real_order", list(&run.order));
    let kinds = [
        ("real", &run.real),
        ("real_predicted", &run.predicted),
        ("real_nocp", &run.nocp),
        ("real_attainable", &run.attainable),
    ];
    for (name, of) in kinds {
        table(name, pairs(&of.offsets, &of.triangles));
        table(&format!("{name}_value"), list(&of.values));
    }
}
