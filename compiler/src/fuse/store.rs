//! Which values of earlier regions a region stores rather than computes again: a minimum cut.
//!
//! A region needs some values that regions before it compute over the same domain. Each value on the way to them is either
//! stored, which takes the time to write and to read it, or computed again from what it is computed from, which takes the time
//! of that. The cheapest choice is a minimum cut of a network in which a value is two nodes: cutting the edge between them stores
//! it, cutting an edge from the source to the first computes it again. Where wide values of a cut do not fit into memory together,
//! those that are dearest to compute again keep their place, and a cut without the others is sought. (The partitioning of forward and backward passes in
//! PyTorch's AOTAutograd is a cut, too, but of what may not be computed again from what is needed.)

use std::collections::{HashMap, HashSet, VecDeque};

/// A value that could be stored.
pub(super) struct Candidate {
    pub id: u64,
    /// What storing it costs, [`NEVER`] where it must not be; of a value that lies in memory in any case, what reading it costs.
    pub stored: u64,
    /// What computing it again costs, given its operands; [`NEVER`] where it lies in memory in any case.
    pub again: u64,
    /// What it takes of the room that stored values share; 0 of those that may be stored in any case.
    pub bytes: usize,
    /// The candidates it is computed from.
    pub operands: Vec<u64>,
}

/// More than anything costs.
pub(super) const NEVER: u64 = u64::MAX;

/// The cheapest set of candidates to read from memory, so that `needed` can be computed, of which all that share `room` fit into it.
pub(super) fn choose(mut candidates: Vec<Candidate>, needed: &[u64], mut room: usize) -> Vec<u64> {
    let index: HashMap<u64, usize> = candidates.iter().enumerate().map(|(i, c)| (c.id, i)).collect();
    loop {
        let chosen = cheapest(&candidates, &index, needed);
        // What takes longest to compute again for its bytes comes first, and keeps its place.
        let worth = |i: &usize| again_from(&candidates, &index, &chosen, *i) as f64 / candidates[*i].bytes as f64;
        let waiting = chosen.iter().filter(|i| candidates[**i].bytes > 0);
        let mut waiting: Vec<(f64, usize)> = waiting.map(|i| (worth(i), *i)).collect();
        waiting.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut fit = true;
        for (_, i) in waiting {
            match room.checked_sub(candidates[i].bytes) {
                Some(rest) => (room, candidates[i].bytes) = (rest, 0),
                None => (candidates[i].stored, fit) = (NEVER, false),
            }
        }
        if fit {
            return chosen.into_iter().map(|i| candidates[i].id).collect();
        }
    }
}

/// What computing the candidate at `which` again costs, from the other chosen ones on.
fn again_from(candidates: &[Candidate], index: &HashMap<u64, usize>, chosen: &[usize], which: usize) -> u64 {
    let mut seen: HashSet<usize> = chosen.iter().copied().collect();
    let (mut stack, mut cost) = (vec![which], 0u64);
    while let Some(i) = stack.pop() {
        let Candidate { stored, again, .. } = candidates[i];
        cost = cost.saturating_add(if again == NEVER { stored } else { again });
        stack.extend(candidates[i].operands.iter().map(|o| index[o]).filter(|o| seen.insert(*o)));
    }
    cost
}

/// The cheapest cut, by the candidates' places.
fn cheapest(candidates: &[Candidate], index: &HashMap<u64, usize>, needed: &[u64]) -> Vec<usize> {
    let (source, sink) = (2 * candidates.len(), 2 * candidates.len() + 1);
    let mut flow = Flow::new(2 * candidates.len() + 2);
    for (i, c) in candidates.iter().enumerate() {
        flow.edge(2 * i, 2 * i + 1, c.stored);
        flow.edge(source, 2 * i, c.again);
        for o in &c.operands {
            flow.edge(2 * index[o] + 1, 2 * i, NEVER);
        }
    }
    for n in needed {
        flow.edge(2 * index[n] + 1, sink, NEVER);
    }
    flow.maximise(source, sink);
    // Of all minimum cuts the one nearest to the needs: what is stored is then used as it is.
    let ahead = flow.reaches(sink);
    let cut = |i: &usize| !ahead[2 * i] && ahead[2 * i + 1];
    (0..candidates.len()).filter(cut).collect()
}

/// Maximum flow by shortest augmenting paths (Edmonds and Karp).
struct Flow {
    /// Edges from every node, as indices into `to` and `room`; edge `e ^ 1` is the reverse of `e`.
    from: Vec<Vec<usize>>,
    to: Vec<usize>,
    room: Vec<u64>,
}

impl Flow {
    fn new(nodes: usize) -> Flow {
        Flow { from: vec![vec![]; nodes], to: vec![], room: vec![] }
    }

    fn edge(&mut self, a: usize, b: usize, room: u64) {
        self.from[a].push(self.to.len());
        self.to.push(b);
        self.room.push(room);
        self.from[b].push(self.to.len());
        self.to.push(a);
        self.room.push(0);
    }

    /// Which nodes still have room to the sink.
    fn reaches(&self, sink: usize) -> Vec<bool> {
        let mut ahead = vec![false; self.from.len()];
        ahead[sink] = true;
        let mut stack = vec![sink];
        while let Some(b) = stack.pop() {
            for e in &self.from[b] {
                // The reverse of an edge out of b is an edge into it.
                if self.room[e ^ 1] > 0 && !ahead[self.to[*e]] {
                    ahead[self.to[*e]] = true;
                    stack.push(self.to[*e]);
                }
            }
        }
        ahead
    }

    /// Saturates the network.
    fn maximise(&mut self, source: usize, sink: usize) {
        loop {
            let mut by: Vec<Option<usize>> = vec![None; self.from.len()];
            let mut reached = vec![false; self.from.len()];
            reached[source] = true;
            let mut queue = VecDeque::from([source]);
            while let Some(a) = queue.pop_front() {
                for e in &self.from[a] {
                    if self.room[*e] > 0 && !reached[self.to[*e]] {
                        reached[self.to[*e]] = true;
                        by[self.to[*e]] = Some(*e);
                        queue.push_back(self.to[*e]);
                    }
                }
            }
            if !reached[sink] {
                return;
            }
            let path: Vec<usize> = std::iter::successors(by[sink], |e| by[self.to[*e ^ 1]]).collect();
            let amount = path.iter().map(|e| self.room[*e]).min().unwrap_or(0);
            for e in path {
                self.room[e] -= amount;
                self.room[e ^ 1] = self.room[e ^ 1].saturating_add(amount);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Candidate, NEVER, choose};

    fn candidate(id: u64, stored: u64, again: u64, operands: &[u64]) -> Candidate {
        Candidate { id, stored, again, bytes: 0, operands: operands.to_vec() }
    }

    /// layer(3) -> series of many 2-channel values, all needed: the layer's 3 channels are stored.
    #[test]
    fn a_narrow_source_is_stored_once() {
        let all: Vec<Candidate> =
            std::iter::once(candidate(0, 3, 50, &[])).chain((1..9).map(|i| candidate(i, 2, 1, &[0]))).collect();
        assert_eq!(choose(all, &[1, 2, 3, 4, 5, 6, 7, 8], 0), vec![0]);
    }

    /// layer(34) -> sum(2), needed: the sum is stored.
    #[test]
    fn a_narrow_result_is_stored_instead_of_its_wide_source() {
        let all = vec![candidate(0, 34, 500, &[]), candidate(1, 34, 1, &[0]), candidate(2, 2, 1, &[1])];
        assert_eq!(choose(all, &[2], 0), vec![2]);
    }

    #[test]
    fn what_is_cheap_from_inputs_is_not_stored() {
        let all = vec![candidate(0, 2, 1, &[]), candidate(1, 2, 0, &[0])];
        assert!(choose(all, &[1], 0).is_empty());
    }

    /// Each step of a chain is cheaper than storing it, all together are not.
    #[test]
    fn the_last_of_a_long_chain_is_stored() {
        let chain = |length: u64| -> Vec<Candidate> {
            (0..length).map(|i| candidate(i, 8, 3, &i.checked_sub(1).into_iter().collect::<Vec<_>>())).collect()
        };
        assert!(choose(chain(2), &[1], 0).is_empty());
        assert_eq!(choose(chain(3), &[2], 0), vec![2]);
    }

    /// A value of one channel from many that lie in memory: reading those takes longer than reading it.
    #[test]
    fn what_must_be_read_to_compute_a_value_counts() {
        let all = |wide: u64| vec![candidate(0, wide, NEVER, &[]), candidate(1, 2, 1, &[0])];
        assert_eq!(choose(all(64), &[1], 0), vec![1]);
        assert_eq!(choose(all(0), &[1], 0), vec![0]);
    }

    /// What must not be stored is computed again, whatever it costs.
    #[test]
    fn without_room_all_is_computed_again() {
        let all = vec![candidate(0, NEVER, 500, &[]), candidate(1, NEVER, 1, &[0])];
        assert!(choose(all, &[1], 0).is_empty());
    }

    fn wide(id: u64, stored: u64, again: u64, operands: &[u64]) -> Candidate {
        Candidate { bytes: 100, ..candidate(id, stored, again, operands) }
    }

    /// Ends of two chains, each dear enough to be stored only together with what is before it.
    #[test]
    fn what_fits_alone_must_fit_together() {
        let all = || vec![wide(0, 9, 6, &[]), wide(1, 9, 6, &[0]), wide(2, 9, 7, &[]), wide(3, 9, 7, &[2])];
        assert_eq!(choose(all(), &[1, 3], 200), vec![1, 3]);
        assert_eq!(choose(all(), &[1, 3], 199), vec![3]);
        assert!(choose(all(), &[1, 3], 99).is_empty());
    }

    /// A value that nobody stores takes no room: not of the layers, but of what follows them.
    #[test]
    fn only_what_is_stored_takes_room() {
        let all = vec![wide(0, 9, 50, &[]), candidate(1, 2, 1, &[0]), wide(2, 9, 40, &[])];
        assert_eq!(choose(all, &[1, 2], 100), vec![1, 2]);
    }

    /// Where the last of a chain has no place, what it is computed from does not take it either.
    #[test]
    fn the_dearest_keeps_its_place() {
        let layer = |id: u64, again: u64| [wide(id, 9, again, &[]), wide(id + 1, 9, 1, &[id])];
        let all = [layer(0, 50), layer(2, 70), layer(4, 60)].into_iter().flatten().collect();
        assert_eq!(choose(all, &[1, 3, 5], 100), vec![3]);
    }
}
