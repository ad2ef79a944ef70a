//! What someone may have meant.

/// Suggestions, at most.
const MAX_SUGGESTIONS: usize = 3;

/// The candidates that few typing errors make of `wanted`, closest first, ties in their order. `plain` gives the form
/// in which a candidate is compared.
pub(super) fn closest(
    wanted: &str,
    candidates: impl Iterator<Item = String>,
    plain: impl Fn(&str) -> String,
) -> Vec<String> {
    let mut near: Vec<(usize, String)> = candidates
        .map(|candidate| (n_edits(wanted, &plain(&candidate)), candidate))
        .filter(|(n_edits, candidate)| 3 * n_edits <= candidate.len().min(wanted.len()))
        .collect();
    near.sort_by_key(|(n_edits, _)| *n_edits);
    let best = near.into_iter().take(MAX_SUGGESTIONS);
    best.map(|(_, candidate)| candidate).collect()
}

/// Characters to insert, delete or replace, at least (Levenshtein distance).
fn n_edits(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.chars().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, y) in b.iter().enumerate() {
            let replaced = diagonal + usize::from(x != *y);
            diagonal = row[j + 1];
            row[j + 1] = replaced.min(diagonal + 1).min(row[j] + 1);
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edits_are_counted() {
        for (a, b, n) in [
            ("", "", 0),
            ("", "abc", 3),
            ("abc", "", 3),
            ("kitten", "sitting", 3),
            ("hoper", "hopper", 1),
            ("ant", "tan", 2),
        ] {
            assert_eq!(n_edits(a, b), n, "{a} {b}");
        }
    }

    #[test]
    fn the_closest_come_first_and_strangers_not_at_all() {
        let candidates = ["abcdef", "abcxyz", "abcdez"].map(str::to_owned);
        let found = closest("abcdee", candidates.into_iter(), str::to_owned);
        assert_eq!(found, ["abcdef", "abcdez"]);
    }
}
