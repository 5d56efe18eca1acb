//! Connected components of a graph.

/// Returns the connected components, each with its nodes ascending, sorted by their first nodes.
/// `neighbours` gives the neighbours of a node; an edge may be listed at either end.
pub fn components<I: Iterator<Item = u32>>(
    nodes: usize,
    neighbours: impl Fn(u32) -> I,
) -> Vec<Vec<u32>> {
    let mut first: Vec<u32> = (0..nodes as u32).collect();
    for node in 0..nodes as u32 {
        for other in neighbours(node) {
            let (a, b) = (root(&mut first, node), root(&mut first, other));
            // The smaller is the root, so that components come in the order of their first nodes.
            first[a.max(b) as usize] = a.min(b);
        }
    }
    let mut parts: Vec<Vec<u32>> = Vec::new();
    let mut place = vec![0; nodes];
    for node in 0..nodes as u32 {
        let first = root(&mut first, node);
        if first == node {
            place[node as usize] = parts.len();
            parts.push(Vec::new());
        }
        parts[place[first as usize]].push(node);
    }
    parts
}

/// Returns the root of the node's set: its smallest node so far. Halves the path on the way.
fn root(first: &mut [u32], mut node: u32) -> u32 {
    while first[node as usize] != node {
        first[node as usize] = first[first[node as usize] as usize];
        node = first[node as usize];
    }
    node
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_lists_in_order() {
        let edges = [vec![3], vec![], vec![5], vec![], vec![0], vec![]];
        let parts = components(6, |node| edges[node as usize].iter().copied());
        assert_eq!(parts, [vec![0, 3, 4], vec![1], vec![2, 5]]);
        assert!(components(0, |_| std::iter::empty()).is_empty());
    }
}
