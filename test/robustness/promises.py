# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""What the package does with each fault, and the test that shows it: a table of test/FAULTS.md.

`PYTHONPATH=.:test python -m robustness --page` writes it after changes of this list.
"""

from page_tables import markdown

PROMISES = {
    # Messages.
    'test_ekf_node.py::test_malformed_messages_are_counted_and_change_nothing':
        ('malformed odometry or poses', 'counted with the reason, no effect'),
    'test_sfa_node.py::test_malformed_images_are_counted_and_end_nothing':
        ('malformed panoramas', 'counted with the reason, no effect'),
    'test_omnicam_node.py::test_it_outlives_every_bad_image_and_counts_each':
        ('malformed images of the camera', 'counted with the reason, no effect'),
    'test_caches.py::test_reasons_are_counted_singly_up_to_a_number_and_then_together':
        ('thousands of different errors', 'the first are counted singly, the rest together'),
    'test_observation.py::test_an_estimate_that_is_not_finite_is_left_out_by_the_filter':
        ('a model that yields NaN', 'the covariance of an unknown pose, and the reason'),
    'test_nodes_base.py::test_nothing_that_is_not_finite_gets_out':
        ('NaN in any output', 'not published'),
    'test_robustness.py::test_of_panoramas_that_come_too_fast_the_newest_is_located':
        ('panoramas faster than they are located', 'the newest is located, older ones are dropped'),
    'test_robustness.py::'
    'test_of_odometry_that_comes_too_fast_the_newest_is_used_and_said_to_be_behind':
        ('odometry faster than it is fused', 'the newest is fused; the state says how late it is'),
    'test_ekf_node.py::test_frames_and_quality_of_service_are_parameters':
        ('publishers with another quality of service', '`qos_overrides` of each topic'),
    # Time.
    'test_pose_filter.py::test_a_bag_that_loops_starts_the_filter_anew':
        ('a bag that loops', 'the filter starts anew, and counts it'),
    'test_ekf_node.py::test_simulated_time_that_does_not_come_is_named_and_that_steps_back_starts_anew':
        ('simulated time that steps back', 'the filter starts anew, and counts it'),
    'test_pose_filter.py::test_a_long_pause_of_the_recording_is_survived_and_reported':
        ('a recording that pauses', 'the covariance grows: LOST until images return'),
    'test_pose_filter.py::test_what_cannot_be_used_is_counted_and_changes_nothing':
        ('stamps that are doubled, zero or too old', 'counted with the reason, no effect'),
    'test_pose_filter.py::test_shuffled_and_late_messages_give_what_messages_in_time_give':
        ('late or shuffled messages', 'up to 5 s late they give the same estimate'),
    'test_robustness.py::test_a_replay_gives_the_same_messages_and_any_pace_the_same_estimate':
        ('a replay at another pace', 'the same estimate, bit by bit'),
    'test_odometry_steps.py::test_odometry_with_poses_may_be_stamped_irregularly':
        ('odometry in bundles, or stamped on reception', 'its poses say how far the robot moved'),
    'test_pose_filter.py::test_images_of_another_clock_neither_end_the_odometry_nor_go_unnoticed':
        ('images of another clock', 'DEGRADED, with the difference of the clocks'),
    'test_odometry_steps.py::test_poses_without_twists_are_no_second_publisher':
        ('poses without twists, each sent several times', 'used as they are'),
    'test_odometry_steps.py::test_an_orientation_that_is_never_filled_is_left_to_the_twist':
        ('an orientation that is never filled', 'the twist is used'),
    'test_pose_filter.py::test_it_learns_by_how_much_tracks_skid_in_turns':
        ('wheels or tracks that skid in turns', 'their factor is learned'),
    # Images.
    'test_pose_filter.py::test_a_spike_is_rejected_and_moves_nothing':
        ('one wrong image', 'outside the gate: rejected'),
    'test_pose_filter.py::'
    'test_a_sustained_offset_is_believed_in_the_end_but_no_images_in_disagreement':
        ('many images that contradict the estimate', 'overrule it only if they agree'),
    'test_pose_filter.py::test_a_cluster_of_wrong_images_after_an_outage_is_not_trusted_at_once':
        ('wrong images after an outage', 'used once several agree with the odometry'),
    'test_sfa_node.py::test_an_unusable_image_gives_no_pose_and_is_reported':
        ('a dark, covered or frozen camera', 'no pose, and the reason'),
    'test_surround_input.py::test_a_faulty_camera_is_hidden_and_named_until_it_is_back':
        ('one of several cameras that is dark, frozen or silent',
         'its sector is hidden; named, after 3 s in a state DEGRADED'),
    'test_surround_bags.py::test_a_camera_that_shows_nothing_of_what_others_see_is_named':
        ('one of several cameras that shows other things: dirt, random pixels',
         'named by `evaluate` and live; DEGRADED'),
    'test_surround_bags.py::test_cameras_whose_images_were_exchanged_are_named':
        ('cameras that have exchanged their topics', 'named by `evaluate` and live; DEGRADED'),
    'test_silence.py::test_a_drive_without_one_of_several_cameras_is_degraded_as_live':
        ('the same in a bag', 'states are those of the nodes'),
    'test_surround_input.py::test_an_image_of_another_camera_is_refused_and_the_others_go_on':
        ('images of another size from one of several cameras', 'refused; the others go on'),
    'test_keyframes.py::test_what_was_never_seen_is_not_believed':
        ('a place outside of the training', 'images are rejected as unlike those of training'),
    'test_omnicam_node.py::test_a_silent_camera_shows_in_diagnostics':
        ('a camera that falls silent', '`/diagnostics` says for how long'),
    'test_capture.py::test_a_defect_in_the_thread_is_reported_and_the_source_opened_again':
        ('an exception while a camera is read', 'the camera is opened again'),
    'test_health.py::test_each_fault_is_found_with_its_size_and_named':
        ('a camera that was moved or turned', 'DEGRADED, with the distance or angle'),
    'test_conditions.py::test_in_another_light_ellipses_are_small_and_hold':
        ('another light than in training', 'the covariance grows with the errors'),
    # Robot and odometry.
    'test_pose_filter.py::test_a_kidnapped_robot_knows_that_it_is_lost_and_recovers':
        ('a robot that is carried away', 'DEGRADED or LOST, then recovery'),
    'test_pose_filter.py::test_images_alone_carry_it_through_an_outage_of_the_odometry':
        ('odometry that drops out', 'images carry the estimate'),
    'test_ekf_node.py::test_silence_is_reported_without_any_clock_moving':
        ('inputs that fall silent', 'the state says for how long'),
    'test_pose_filter.py::test_standing_still_neither_drifts_nor_becomes_overconfident':
        ('a robot that stands for long', 'no drift, no shrinking covariance'),
    'test_pose_filter.py::test_exact_data_straight_turning_and_reversing':
        ('reversing, straight lines, yaw at +-180 degrees', 'zero error on exact data'),
    'test_pose_filter.py::test_covariance_stays_symmetric_positive_over_a_long_run':
        ('a very long drive', 'the covariance stays symmetric and positive definite'),
    'test_filter_consistency.py::test_the_filter_as_shipped_errs_as_it_says':
        ('noise as large as stated', 'errors agree with the covariance (NEES)'),
    'test_breaks.py::test_a_pose_that_jumps_goes_on_only_where_its_twist_says_so':
        ('a training drive whose odometry jumps', 'joined by its twist, or cut there'),
    # Nodes.
    'test_robustness.py::test_the_nodes_start_in_any_order':
        ('nodes started in any order', 'the same pose'),
    'test_faults.py::test_a_node_that_ends_and_comes_back_is_no_harm':
        ('a node that dies and is started again', 'not LOCALISED and wrong'),
    'test_node_processes.py::test_a_signal_at_any_moment_ends_with_exit_code_0':
        ('SIGINT or SIGTERM at any moment', 'exit code 0'),
    'test_node_processes.py::test_a_wrong_parameter_ends_the_node_with_its_name':
        ('a wrong parameter', 'the node ends, and names it'),
    'test_nodes_base.py::test_a_wrong_live_change_is_rejected_and_changes_nothing':
        ('a wrong change of a parameter', 'rejected with the reason'),
    'test_node_processes.py::test_what_rclpy_cannot_handle_itself_ends_nothing':
        ('a lifecycle transition out of order', 'logged and counted, no effect'),
    'test_sfa_node.py::test_a_missing_model_is_named_with_the_remedy':
        ('a missing model', 'named with the remedy'),
    'test_place_model.py::test_a_damaged_model_is_refused_with_the_remedy':
        ('a damaged model', 'refused with the remedy'),
    'test_sfa_node.py::test_panoramas_unlike_those_of_training_are_rejected_with_the_remedy':
        ('a model of other panoramas', 'images are rejected with the remedy'),
    'test_history.py::test_it_stays_bounded_and_knows_what_it_no_longer_reaches':
        ('hours of driving', 'bounded memory (an hour: `make soak`)'),
    # Bags and training.
    'test_bag.py::test_a_cut_off_file_is_read_up_to_the_cut':
        ('a bag that was cut off', 'read up to the cut'),
    'test_bag.py::test_a_cut_off_bag_counts_what_is_lost':
        ('a bag whose end is missing', 'the share of lost messages is reported'),
    'test_bag.py::test_what_holds_no_bag_is_one_error':
        ('a file that is no bag', 'one line of error'),
    'test_bag_topics.py::test_a_missing_or_wrong_topic_names_the_remedy':
        ('a missing or wrong topic', 'one line of error with the option to use'),
    'test_fuzz.py::test_damaged_bags':
        ('random damage to bags', 'one line of error'),
    'test_training.py::test_after_an_error_no_model_is_left':
        ('a training that fails', 'no half-written model'),
    'test_training.py::test_resuming_gives_the_same_bytes':
        ('a training that is killed', '`--resume` gives the same model'),
    # All faults of faults.py.
    'test_faults.py::test_the_filter_is_never_sure_and_wrong':
        ('each fault of `robustness/faults.py`', 'LOCALISED and wrong for 1.5 s at most'),
    'test_faults.py::test_no_fault_is_believed_for_long_or_makes_the_estimate_worse':
        ('the same, the filter alone', 'mean errors no worse than in a recorded run'),
    'test_faults.py::test_no_lie_is_believed_for_long':
        ('lies: they contradict no other input at first', 'LOCALISED and wrong for 5 s at most'),
    'test_faults.py::test_the_nodes_do_with_a_fault_what_the_localizer_does':
        ('each fault, through the three nodes', 'the same as `Localizer`'),
}  # fmt: skip
"""Fault and what the package does, by test."""


def table():
    """Return the table of the page, a row for each fault."""
    rows = [[*texts, f'`{test}`'] for test, texts in PROMISES.items()]
    return markdown(['fault', 'what the package does', 'test'], rows)
