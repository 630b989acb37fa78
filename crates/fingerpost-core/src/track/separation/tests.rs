//! The decision alone; the measurements that it is based on are tested with the tracker.

use super::*;

#[test]
fn the_foreground_test_lowers_the_required_separation() {
    assert!(stands_out(MIN_SEPARATION, 0.0, || unreachable!("it stands out anyway")));
    for separation in [MIN_SEPARATION_OF_FOREGROUND, 1.0] {
        assert!(stands_out(separation, 0.0, || Some(true)));
        assert!(!stands_out(separation, 0.0, || Some(false)));
        // An unknown table gives no result of the foreground test.
        assert!(!stands_out(separation, 0.0, || None));
    }
    assert!(!stands_out(0.99 * MIN_SEPARATION_OF_FOREGROUND, 0.0, || Some(true)));
}

#[test]
fn a_wholly_explained_contour_lowers_the_required_separation_further() {
    assert!(stands_out(MIN_SEPARATION_IF_EXPLAINED, NEARLY_ALL_EXPLAINED, || unreachable!(
        "it stands out anyway"
    )));
    assert!(!stands_out(MIN_SEPARATION_IF_EXPLAINED, 0.99 * NEARLY_ALL_EXPLAINED, || Some(true)));
    assert!(!stands_out(0.99 * MIN_SEPARATION_IF_EXPLAINED, 1.0, || Some(true)));
}
