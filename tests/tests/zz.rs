use coboot_tests::fleet::{measure, Way};
#[test]
fn t() {
    measure(|row| {
        let way = if row.way == Way::Together { "together" } else { "one by one" };
        let lost =
            if row.lost_one_in == 0 { "none".to_string() } else { format!("1 in {}", row.lost_one_in) };
        println!(
            "  {:>7} {way:>12} {:>11} {lost:>13} {:>10.3} s {:>12.2} x",
            row.boards,
            row.block_size,
            row.took.as_secs_f64(),
            row.took.as_secs_f64() / row.one.as_secs_f64()
        );
    });
}
