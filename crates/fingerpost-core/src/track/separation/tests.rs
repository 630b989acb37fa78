//! What stands out is decided here, between measurements that are tested with the tracker.

use super::*;

#[test]
fn what_stands_free_need_not_differ_as_much() {
    assert!(stands_out(STANDS_OUT, 0.0, || unreachable!("it stands out anyway")));
    for separation in [STANDS_OUT_FREE, 1.0] {
        assert!(stands_out(separation, 0.0, || Some(true)));
        assert!(!stands_out(separation, 0.0, || Some(false)));
        // Of a table that is not known nothing stands free.
        assert!(!stands_out(separation, 0.0, || None));
    }
    assert!(!stands_out(0.99 * STANDS_OUT_FREE, 0.0, || Some(true)));
}

#[test]
fn what_is_seen_whole_need_differ_even_less() {
    assert!(stands_out(STANDS_OUT_WHOLE, WHOLE, || unreachable!("it stands out anyway")));
    assert!(!stands_out(STANDS_OUT_WHOLE, 0.99 * WHOLE, || Some(true)));
    assert!(!stands_out(0.99 * STANDS_OUT_WHOLE, 1.0, || Some(true)));
}
