"""Lines that stand between the tool and a false claim, each with a fault and the tests that must notice it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Mutant:
    """One fault."""

    name: str
    """What is broken, in a few words."""
    file: str
    """Where, from the root of the repository."""
    line: str
    """Part of the text that is there once."""
    fault: str
    """What stands there instead."""
    tests: tuple[str, ...]
    """Test files, or single tests, that must notice; the quickest first."""


def _of(package, *mutants):
    """Return the mutants of (name, file, line, fault, tests) in a package."""
    return tuple(Mutant(name, f'{package}/{file}', line, fault, tuple(f'test/{test}' for test in tests.split()))
                 for name, file, line, fault, tests in mutants)


NOISE = _of(
    'imu_calibration/estimation',
    ('scatter from window to window dropped from weights', 'noise_model.py', 'white = self.low_variance * np.stack(', 'white = 1e-3 * self.low_variance * np.stack(',
     'test_noise_model.py::test_means_scatter_by_the_noise_at_low_frequency_over_their_number'),
    ('noise at low frequency taken for white', 'noise_model.py', 'return self.white_variance * self.inflation', 'return self.white_variance * 1.0',
     'test_noise_model.py::test_means_scatter_by_the_noise_at_low_frequency_over_their_number'),
    ('encoders have no steps where turns are read', 'noise_model.py', 'cls(turn=step / np.sqrt(6))', 'cls(turn=0.0 * step)',
     'test_search.py::test_a_turn_that_is_read_in_steps_leaves_more_in_the_mean_rate_than_the_sensor'),
    ('biases stand still within windows', 'noise_model.py', 'step = np.asarray(durations, float) / (6', 'step = 0.0 * np.asarray(durations, float) / (6',
     'test_noise_model.py::test_a_mean_over_a_window_differs_from_the_bias_in_its_middle_by_what_it_wanders'),
    ('knocked rests enter the noise', 'noise_at_rest.py', "(variances[:, axis] <= 2 * usual) & (variances[:, axis] >= 0.5 * usual)",
     'variances[:, axis] > 0', 'test_noise_model.py::test_a_knocked_rest_does_not_enter_the_noise'),
    ('variance from few data taken for certain', 'noise_model.py', 'DOF_FACTOR_MOST = 3.0', 'DOF_FACTOR_MOST = 1.0', 'test_noise_model.py::test_a_variance_from_few_data_is_taken_larger'),
    ('slow misfit not weighed apart', 'band_misfit.py', 'apart = of_fast > APART * cautious', 'apart = of_fast > np.inf * cautious', 'test_bands.py::test_a_wrong_gain_at_high_frequency_does_not_bend_the_estimate'),
    ('caution about the slow misfit dropped', 'band_misfit.py', 'SURE = 2.0', 'SURE = 0.0', 'test_bands.py::test_the_slow_misfit_of_few_pieces_is_taken_larger'),
    ('correlated misfit along the columns not seen', 'band_misfit.py', 'STRONG = 1e-6', 'STRONG = 2.0', 'test_noise_model.py::test_misfit_along_the_columns_shows_how_correlated_it_is'),
)
COVARIANCE = _of(
    'imu_calibration/estimation',
    ('prior of held parameters left out of the covariance', 'scaled_solve.py', 'total = influence @ np.diag(prior_sd[held]**2) @ influence.T',
     'total = 0 * influence @ np.diag(prior_sd[held]**2) @ influence.T', 'test_estimation.py::test_undetermined_parameters_are_held_and_carried'),
    ('nothing is ever held', 'solver.py', 'HELD_SHARE = 0.5', 'HELD_SHARE = 5.0', 'test_estimation.py::test_undetermined_parameters_are_held_and_carried'),
    ('misfit does not widen standard deviations', 'model_error.py', 'factor[waves.places[group]] = np.sqrt(waves.scatter(group)[1])',
     'factor[waves.places[group]] = 1.0', 'test_model_error.py::test_parts_that_ask_for_more_than_noise_explains_widen_by_half_more_than_they_show'),
    ('drifts do not widen standard deviations', 'model_error.py', 'more[waves.places[group]] = waves.drift(group)[1]',
     'more[waves.places[group]] = 0.0', 'test_model_error.py::test_a_parameter_that_drifts_has_a_standard_deviation_that_repeats'),
    ('standard deviations widen by chance', 'model_error.py', 'CHANCE = 0.01', 'CHANCE = 0.9', 'test_model_error.py::test_clean_sessions_stay_as_they_are'),
    ('values that only misfit gives are believed', 'unbelievable.py', '(size > _limit(effect)) & ', '(size < 0) & ', 'test_believing.py::test_a_scale_that_only_misfit_gives_is_held_and_named'),
    ('a wrong full scale is taken for misfit', 'unbelievable.py', ' & (size < sd[part] * max(feigned[sensor] for sensor in sensors))', '',
     'test_believing.py::test_a_wrong_full_scale_setting_is_no_misfit'),
    ('unasked values do not shrink', 'shrinkage.py', 'values -= min(1.0, ', 'values -= min(0.0, ', 'test_believing.py::test_what_nobody_asked_for_shrinks_and_what_is_plain_stays'),
    ('unasked values vanish', 'shrinkage.py', 'min(1.0, known.sum() / max(chi2, 1e-300))', '1.0', 'test_believing.py::test_what_nobody_asked_for_shrinks_and_what_is_plain_stays'),
)
SEARCH = _of(
    'imu_calibration/selection',
    ('offsets of windows left out of the evidence', 'normal_matrices.py', ' + own.offset_sd**2', '', 'test_search.py::test_offsets_of_windows_are_in_the_weights_of_the_evidence'),
    ('gain judged on the windows that chose it', 'gain.py', '_squares(attempt.locked_samples, each', '_squares(attempt.all_samples, each', 'test_search.py::test_the_gain_is_that_of_locked_windows_by_the_measure_of_the_others'),
    ('locked windows take part in the fit', 'attempt.py', 'recording.select(~locked)', 'recording', 'test_diagnosis.py::test_what_locked_windows_show_moves_the_gain_and_nothing_else'),
    ('locked windows show limits', 'clipping.py', '_limits(windows_at(windows, piled | ~locked), table, model)', '_limits(windows, table, model)', 'test_saturation.py::test_locked_windows_show_no_limit'),
    ('a limit that one window alone shows is locked away', 'clipping.py', 'piled | ~locked', '~locked', 'test_saturation.py::test_a_limit_that_one_window_alone_shows_is_seen'),
    ('cross-validation that leaks', 'evidence.py', ' - np.asarray(self._parts)[:, places[:, None], places]',
     ' + 0 * np.asarray(self._parts)[:, places[:, None], places]', 'test_search.py::test_a_finding_predicts_what_it_was_not_fitted_to test_search.py::test_noise_gains_nothing_where_it_was_not_fitted'),
    ('interval of 50 % called 95 %', 'gain.py', '(0.025, 0.975)', '(0.25, 0.75)', 'test_search.py::test_an_interval_of_95_percent_holds_95_percent'),
    ('correction for the number of effects dropped', 'search.py', 'self.evidence.p_value(smaller, larger) * len(self.questions)',
     'self.evidence.p_value(smaller, larger)', 'test_search.py::test_among_many_effects_one_is_significant_by_chance'),
    ('significance of one in a thousand becomes 50 %', 'search.py', 'FAMILY_WISE = 0.001', 'FAMILY_WISE = 0.5', 'test_search.py::test_among_many_effects_one_is_significant_by_chance'),
    ('gain on held-out windows not asked for', 'search.py', ' and self.net > 0 and self.gain > LEAST_GAIN', '', 'test_search.py::test_a_finding_predicts_what_it_was_not_fitted_to'),
    ('a negative time constant is allowed', 'search.py', 'if question.effect.nonnegative and value[0] < 0:', 'if False:', 'test_search.py::test_no_lag_is_negative_no_angle_within_an_encoder_step_no_size_beyond_what_is_known'),
    ('steps of the encoder pass for errors of the table', 'search.py', 'return 0.5 * encoder_step', 'return 0.0 * encoder_step', 'test_search.py::test_no_lag_is_negative_no_angle_within_an_encoder_step_no_size_beyond_what_is_known'),
    ('implausible sizes are explanations', 'search.py', '(self.any_size or not self.implausible(chosen, question))', 'True', 'test_search.py::test_no_lag_is_negative_no_angle_within_an_encoder_step_no_size_beyond_what_is_known'),
    ('earlier choices never reconsidered', 'search.py', 'chosen = self.reconsidered([*chosen, best.question])', 'chosen = [*chosen, best.question]',
     'test_search.py::test_an_earlier_choice_gives_way_to_what_explains_better_together'),
    ('share of the unexplained that a finding must remove', 'explained_share.py', 'LEAST_SHARE = 0.7', 'LEAST_SHARE = 0.1', 'test_search.py::test_what_leaves_most_unexplained_is_not_named'),
    ('the same for what is smooth in time', 'explained_share.py', 'LEAST_SHARE_SMOOTH = 0.9', 'LEAST_SHARE_SMOOTH = 0.1', 'test_search.py::test_what_leaves_most_unexplained_is_not_named'),
    ('a cause of the table need not show in both sensors', 'explained_share.py', 'return min((removed / (removed', 'return max((removed / (removed', 'test_search.py::test_a_cause_of_the_table_shows_in_both_sensors'),
    ('the quiet of two axes hides the third', 'explained_share.py', 'left = np.where(alone > SIGNIFICANT_REST, excess, 0.0)', 'left = np.where(alone > 1e9, excess, 0.0)', 'test_search.py::test_what_one_axis_has_is_not_hidden_by_the_quiet_of_the_others'),
    ('one of three axes costs no more than one', 'explained_share.py', 'ONE_OF_THREE = 6.0 / 5.0', 'ONE_OF_THREE = 1.0', 'test_search.py::test_what_one_axis_has_is_not_hidden_by_the_quiet_of_the_others'),
    ('biases do not move by nature', 'bias_process_search.py', 'NATURAL = 0.5', 'NATURAL = 0.0', 'test_search.py::test_every_bias_moves_by_half_the_white_noise_of_a_second'),
    ('whatever a bias was found to do passes for noise', 'noise_beside_effects.py', 'PLAUSIBLE = 3.0', 'PLAUSIBLE = 800.0', 'test_search.py::test_a_wander_that_was_found_passes_for_noise_as_far_as_biases_wander'),
    ('a cable that pulls along one axis passes for noise', 'noise_beside_effects.py', 'ALIKE, FAR = 3.0, 4.0', 'ALIKE, FAR = 300.0, 4.0',
     'test_search.py::test_a_wander_that_was_found_passes_for_noise_as_far_as_biases_wander'),
    ('offsets of windows cost nothing', 'bias_process_search.py', 'OFFSETS = 10.0', 'OFFSETS = 0.0', 'test_search.py::test_offsets_of_windows_have_their_price'),
    ('a resolved lag is replaced and cannot come back', 'search.py', 'if question.name in self.resolved:', 'if False:', 'test_search.py::test_what_was_resolved_is_not_replaced'),
    ('what replaces an effect may be chance', 'search.py', 'and self.score(rest, other).significant:', 'and True:',
     'test_search.py::test_what_replaces_an_effect_is_significant_itself'),
    ('a wander of any size costs nothing', 'bias_process_search.py', '/ SPREAD)**2 if self.least', '/ SPREAD)**2 * 0.0 if self.least', 'test_search.py::test_a_wander_far_beyond_the_natural_one_has_its_price'),
    ('a smooth effect need not beat the wander of the bias', 'noise_beside_effects.py', 'STRONG = 10.0', 'STRONG = -50.0',
     'test_search.py::test_what_is_smooth_in_time_has_to_beat_the_wander_of_the_bias'),
    ('what a search starts from may be chance', 'search.py', 'def _dropped(self, chosen):', 'def _dropped(self, chosen):\n        if len(chosen) < 2:\n            return None',
     'test_search.py::test_what_a_search_starts_from_is_significant_by_itself_too'),
    ('a bias that wanders within windows is a drift', 'parameter_space.py', 'np.where(np.append(smooth, False), 0.0, full)', 'full.copy()', 'test_search.py::test_within_windows_nothing_is_told_of_what_is_smooth_in_time'),
    ('what a drift does within windows is left unexplained', 'evidence.py', 'join_within=self.space.join)', 'join_within=self.space.join_within)',
     'test_search.py::test_what_a_drift_does_within_windows_is_predicted_and_tells_nothing_of_it'),
    ('how far windows agree is not asked', 'investigation.py', 'and attempt.windows_agree(named, question)]', ']', 'test_search.py::test_what_the_windows_disagree_on_is_not_named'),
    ('windows agree whatever they scatter', 'evidence.py', 'np.linalg.solve(moved.T @ moved, values[places])', 'np.linalg.solve(covariance[np.ix_(places, places)], values[places])',
     'test_search.py::test_windows_agree_on_a_finding'),
    ('all windows of a kind scatter alike', 'normal_matrices.py', '+ (scatter - 1) * own', '+ 0 * (scatter - 1) * own', 'test_search.py::test_a_window_that_scatters_more_within_has_a_less_certain_mean'),
    ('what only one window tells is held against it', 'evidence.py', 'found[sensor][0, axis] -= (slopes', 'found[sensor][0, axis] -= 0 * (slopes', 'test_search.py::test_what_only_one_window_tells_is_not_held_against_it'),
    ('a drift of a quiet instrument is asked for as of a consumer one', 'noise_beside_effects.py', 'return np.minimum(prior_sd, WIDEST', 'return np.maximum(prior_sd, WIDEST',
     'test_search.py::test_a_quiet_instrument_drifts_less'),
    ('halves that disagree are not asked', 'investigation.py', 'if not attempt.agrees_in_halves(named, question)]', 'if False]', 'test_search.py::test_what_the_halves_disagree_on_is_denied'),
    ('halves disagree by chance', 'halves.py', 'DISAGREE = 1e-4', 'DISAGREE = 0.5', 'test_search.py::test_halves_agree_within_chance'),
    ('a finding need not lower the residual in its own unit', 'investigation.py', 'short = [not paid > _needed_reduction(attempt, explained, kept, each) for paid, each in zip(least, kept)]',
     'short = [False for each in kept]', 'test_search.py::test_a_finding_lowers_the_residual_in_the_sensors_own_unit test_search.py::test_what_the_halves_disagree_on_is_denied'),
    ('members of a pair imitate each other', 'pairs.py', 'UNIQUE = 0.05', 'UNIQUE = -1.0', 'test_pairs.py::test_what_the_other_can_imitate_is_no_member'),
    ('pairs may leave most of a rest', 'investigation.py', 'LEFT = 0.1', 'LEFT = 1.0', 'test_pairs.py::test_what_leaves_a_fifth_is_not_taken'),
    ('another look where nothing is left', 'investigation.py', 'if not outcome.rest:', 'if False:', 'test_pairs.py::test_pairs_are_asked_where_a_rest_stays'),
    ('limits need not agree with the motion', 'saturation.py', 'AGREEMENT = 0.25', 'AGREEMENT = 0.0', 'test_saturation.py::test_a_limit_is_where_the_motion_passes_it'),
    ('coarse outputs pass for clipped ones', 'saturation.py', 'return bool(at > 3 * repeats[-5:].max(initial=1))', 'return True', 'test_saturation.py::test_gravity_on_the_highest_steps_of_a_coarse_output_is_no_limit'),
    ('clipped samples stay', 'saturation.py', 'good &= ~(near | at).any(axis=1)', 'good &= ~(near & ~near | at & ~at).any(axis=1)', 'test_saturation.py::test_samples_at_a_limit_and_those_predicted_near_it_are_left_out'),
)
BEYOND = _of(
    'imu_calibration/beyond',
    ('threshold of what is unexplained', 'unexplained.py', 'SIGNIFICANT = 5.0', 'SIGNIFICANT = 50.0', 'test_search.py::test_a_rest_of_some_standard_deviations_is_unexplained'),
    ('any correlation is told', 'unexplained.py', 'if p_value < ALPHA and share > max(best[1], 0.15):', 'if share > best[1]:', 'test_search.py::test_noise_goes_with_nothing'),
    ('a line of few stretches is a tone', 'spectrum.py', 'np.where(hits > MOSTLY * count[:, None], binom',
     'np.where(hits > 0, 0 * binom', 'test_spectrum.py'),
    ('a finding that a formula does without stays', 'inquiry.py', 'if sum(beside.values()) < NOT_NEEDED * sum(alone.values()):', 'if False:',
     'test_beyond_catalogue.py'),
    ('a place is known to its bins only', 'regimes.py', 'return regime if other is None or', 'return regime if True or', 'test_regimes.py'),
    ('of what scatters the whole range is told', 'regimes.py', 'NEARLY_ALL = 0.95', 'NEARLY_ALL = 1.0', 'test_regimes.py'),
    ('a place is no reason to withdraw a name', 'inquiry.py', 'return np.stack([first.get(axis, nowhere) for axis in AXES], axis=1)[:, None].astype(float) if first else None',
     'return None', 'test_beyond_catalogue.py'),
    ('calibrate adopts what a formula does without', 'inquiry.py', 'while found.named and (gone', 'while False and (gone',
     'test_by_evidence.py::test_calibrate_does_not_adopt_what_diagnose_withdraws'),
    ('a finding goes for any formula', 'inquiry.py', 'if sum(beside.values()) < NOT_NEEDED * sum(alone.values()):', 'if True:',
     'test_beyond_catalogue.py'),
)
HAND = _of(
    'imu_calibration',
    ('gravity enters the gyroscope by chance', 'by_hand/g_sensitivity.py', 'P_VALUE = 1e-3', 'P_VALUE = 0.9', 'test_hand_faults.py::test_a_warm_up_is_not_sold_as_g_sensitivity test_hand_faults.py::test_a_drift_is_not_sold_as_g_sensitivity_where_attitudes_follow_each_other_in_order test_by_hand.py'),
    ('time is not asked beside gravity', 'by_hand/g_sensitivity.py', '[np.ones(count), time, time**2][:3 if count >= 12 else 2]', '[np.ones(count)]',
     'test_hand_faults.py::test_a_warm_up_is_not_sold_as_g_sensitivity test_hand_faults.py::test_a_drift_is_not_sold_as_g_sensitivity_where_attitudes_follow_each_other_in_order'),
    ('the Earth answers to gravity', 'by_hand/g_sensitivity.py', 'np.clip(upwards, -EARTH_RATE, EARTH_RATE)', 'np.clip(upwards, 0, 0)',
     'test_hand_faults.py::test_the_earth_is_not_sold_as_g_sensitivity'),
    ('what is held is asked for by other names', 'by_hand/inquiry.py', 'tuple(range(baseline.model.size + 1))', 'tuple(range(12))',
     'test_diagnosis_by_hand.py::test_what_held_parameters_may_be_is_no_finding'),
    ('drifts do not widen sds by hand', 'by_hand/bias_movement.py', 'grown[index[:3], index[:3]] += (movement.size / 2)**2', 'grown[index[:3], index[:3]] += 0',
     'test_hand_faults.py::test_biases_that_drift_carry_it_in_their_sd_and_a_note_with_its_size'),
    ('a place among few poses costs nothing', 'diagnosis/by_hand/where.py', 'BY_CHANCE = 0.01', 'BY_CHANCE = 1e9',
     'test_diagnosis_by_hand.py::test_a_place_among_few_poses_is_paid_for'),
    ('a hysteresis is asked where it warms up only', 'selection/questions.py', 'BRANCHES_APART = 1.5', 'BRANCHES_APART = 0.0',
     'test_thermal_branch.py::test_it_is_asked_only_where_the_temperature_turned'),
    ('a rectification is asked where nothing vibrates', 'selection/questions.py', "if 'vibration' in effect.needs and not shaken:", 'if False:',
     'test_vibration.py::test_it_is_asked_only_where_rests_vibrate_unlike'),
    ('a hand passes for vibration', 'segmentation/quiet_detector.py', 'quiet | (below & _steady(', 'quiet | (_steady(',
     'test_windows.py::test_a_table_that_vibrates_rests_where_its_joints_stand_and_one_that_is_moved_or_knocked_does_not'),
    ('a knock passes for vibration', 'segmentation/quiet_detector.py', 'variance <= ratio**2 * floor, axis=0', 'variance <= np.inf, axis=0',
     'test_windows.py::test_a_table_that_vibrates_rests_where_its_joints_stand_and_one_that_is_moved_or_knocked_does_not'),
    ('a vibration is the noise of all rests', 'estimation/noise_at_rest.py', 'return (quiet if shaken else median), shaken', 'return median, False',
     'test_vibration.py::test_rests_that_vibrate_do_not_make_the_noise_of_the_quiet_ones'),
    ('vibration is not followed live', 'compensation/sample_compensation.py', 'if self._shakes else NO_SLOPE', 'if False else NO_SLOPE',
     'test_vibration.py::test_compensation_live_and_of_a_recording_take_the_rectification_out'),
    ('what comes after a turn is on the old branch', 'compensation/sample_compensation.py', 'self.branch.push(temperature_c)', 'pass',
     'test_thermal_branch.py::test_compensation_live_and_of_a_recording_take_the_branch_out'),
    ('what does not belong to the others stays', 'by_hand/outliers.py', 'if p * max(len(own), 1) < P_VALUE]', 'if p < 0]', 'test_hand_faults.py::test_a_pose_a_rest_and_a_turn_that_were_disturbed_are_left_out'),
    ('missed turns stay', 'by_hand/outliers.py', 'CONTRADICTED = 0.35', 'CONTRADICTED = 9.0', 'test_hand_faults.py::test_what_was_left_out_does_not_come_back_in_the_proof'),
    ('slow turns are poses', 'segmentation/static_detector.py', 'keep[1:-1] &= np.all(', 'keep[1:-1] |= np.all(', 'test_hand_faults.py::test_a_slow_turn_about_the_vertical_is_no_pose'),
    ('spikes stay', 'segmentation/spike_filter.py', 'LARGE = 8.0', 'LARGE = 8e9', 'test_spike_filter.py'),
    ('fast motion passes for spikes', 'segmentation/spike_filter.py', 'np.maximum(1.4 * limit, ROUGH * rough)', '1.4 * limit', 'test_spike_filter.py'),
)
TRUST = _of(
    'imu_calibration',
    ('bad verdicts are used', 'calibration/trust.py', 'if word == BAD else []', 'if False else []', 'test_trust.py'),
    ('disproven calibrations are used', 'calibration/trust.py', '*disproved(proof)]', ']', 'test_trust.py'),
    ('a calibration for another sensor is taken', 'nodes/adoption.py', 'calibration.frame_id != known:', 'False:', 'test_adoption.py'),
    ('whatever a document does ends the node', 'nodes/adoption.py', 'except Exception as error:   # whatever', 'except ZeroDivisionError as error:   # whatever',
     'test_adoption.py'),
    ('help that is not shown counts as help', 'calibration/proof_words.py', " and found['ci95'][1] < 1.0)", ')', 'test_proof.py test_trust.py'),
    ('harm in some motion is passed over', 'calibration/proof_words.py', "part['after'] > HARM * part['before']", "part['after'] > 99 * part['before']",
     'test_proof.py test_trust.py'),
    ('proof on windows that were fitted', 'calibration/held_out.py', 'for k, part in enumerate(parts) if k != fold)', 'for k, part in enumerate(parts))',
     'test_proof.py::test_a_fold_is_left_out_as_if_it_had_not_been_recorded'),
    ('the mount that bends goes from one side of the proof', 'calibration/proof.py', "== 'none' and not _of_reference(effect):", "== 'none' and not effect.in_reference:",
     'test_proof.py::test_both_sides_are_compared_with_the_same_table'),
    ('misfit is not a reason', 'calibration/reasons.py', 'MISFIT = 10.0', 'MISFIT = 1e9', 'test_verdict.py'),
    ('weak called determined', 'calibration/status.py', 'DETERMINED if s <= t else WEAK', 'DETERMINED if s <= 9 * t else WEAK', 'test_status.py'),
    ('held called determined', 'calibration/status.py', 'HELD if h else DETERMINED', 'DETERMINED if h else DETERMINED', 'test_status.py'),
    ('weak values applied whatever they cost', 'compensation/compensate.py', 'applied_values(', '(lambda known: known.values)(', 'test_believing.py'),
)
FILES = _of(
    'imu_calibration',
    ('files written where they stand', 'files.py', "beside = path.parent / f'.{os.getpid()}.{zlib.crc32(path.name.encode(errors=\"replace\")):08x}'", 'beside = path',
     'test_disk_faults.py test_cli_bad_input.py'),
    ('no limit to nesting', 'documents.py', 'DEEPEST = 20', 'DEEPEST = 10**9', 'test_documents.py'),
    ('aliases allowed', 'documents.py', "if kind == 'AliasEvent':", 'if False:', 'test_documents.py'),
    ('another model is resumed', 'calibration/accumulator_state.py', 'if not known.has_columns_of(model):', 'if False:', 'test_session_files.py test_live_calibration.py'),
    ('another temperature is resumed', 'effects/sensor_model.py', ", 'temperature_ref_c', 'definitions')", ", 'definitions')",
     'test_live_calibration.py test_session_files.py'),
)
SIGNS = _of(
    'imu_calibration',
    ('centripetal term with the other sign', 'reference/reference_motion.py', 'return skew(alpha_s) + cross @ cross', 'return skew(alpha_s) - cross @ cross',
     'test_zhang.py test_physics_and_catalogue.py'),
    ('tangential term with the other sign', 'reference/reference_motion.py', 'return skew(alpha_s) + cross @ cross', 'return -skew(alpha_s) + cross @ cross',
     'test_zhang.py test_physics_and_catalogue.py'),
    ('parameters left out of the published covariance', 'compensation/covariance.py', 'self.parameters[k:k + 3, k:k + 3] if with_parameters else total',
     'total * 0 if with_parameters else total', 'test_compensation_covariance.py'),
    ('delay of the derivative left out of the published covariance', 'compensation/covariance.py', '(self.earlier * rate_cov + error_cov)',
     '(self.earlier * rate_cov)', 'test_compensation_covariance.py test_rate_slope.py'),
    ('bias added instead of taken away', 'compensation/kernel.py', '[added(row, {(): -constant})', '[added(row, {(): constant})', 'test_compensation_kernel.py'),
)
LIVE = _of(
    'imu_calibration',
    ('an open window counts twice', 'calibration/live.py', 'gathered, store = collector.snapshot(pending)',
     'gathered, store = collector.snapshot(True)', 'test_live_calibration.py::test_windows_that_are_open_count_only_when_asked_for'),
    ('what is found live never joins the model', 'calibration/live.py', 'collector.take_model(model)', 'pass', 'test_live_diagnosis.py::test_a_resumed_session_keeps_what_joined'),
    ('the model as asked grows live', 'calibration/live.py', 'self.options.as_asked or demand', 'demand', 'test_live_diagnosis.py::test_the_model_as_asked_stays'),
    ('windows that are gone are taken anew', 'calibration/live_snapshot.py', 'if self.store.complete:', 'if True:', 'test_live_diagnosis.py::test_what_cannot_join_is_said_and_widens'),
    ('a resumed session forgets what joined', 'calibration/live.py', 'Demand() if saved is None or options.as_asked else', 'Demand() if True else',
     'test_live_diagnosis.py::test_a_resumed_session_keeps_what_joined'),
    ('what is denied live does not widen', 'calibration/live.py', 'conclude(self.demand.applied(solution)', 'conclude(solution', 'test_live_diagnosis.py::test_what_cannot_join_is_said_and_widens'),
    ('whoever saves does not wait for the answer', 'nodes/diagnosis_thread.py', 'if question is not None and self.period and not', 'if False and not',
     'test_live_diagnosis.py::test_who_saves_waits_for_the_answer_and_asks_the_same_once'),
    ('an earlier run is forgotten', 'calibration/live.py', 'return merge([copied(self.earlier), gathered])', 'return gathered', 'test_live_calibration.py::test_a_session_resumed_from_its_state_equals_two_recordings'),
    ('solving again adds the earlier run again', 'calibration/live.py', 'merge([copied(self.earlier), gathered])', 'merge([self.earlier, gathered])',
     'test_live_calibration.py::test_a_session_resumed_from_its_state_equals_two_recordings'),
)
BY_SENSOR = _of(
    'imu_calibration',
    ('a sensor without a proof is used beside a refused one', 'calibration/trust.py', 'if sensor not in against and sensor not in calibration.proof:',
     'if False:', 'test_verdict_by_sensor.py::test_who_is_refused'),
    ('by hand the gyroscope is used beside a refused accelerometer', 'calibration/trust.py', 'calibration.gauge.get(\'axes\') == HAND_AXES', 'False',
     'test_verdict_by_sensor.py::test_who_is_refused'),
    ('documents that were judged as a whole are judged by sensor', 'calibration/trust.py', 'if BAD in calibration.verdicts.values() else word',
     'if calibration.verdicts else GOOD', 'test_trust.py::test_a_verdict_on_both_is_one_on_each_where_nobody_judged_them_apart'),
    ('what a refused sensor reads still corrects the other one', 'calibration/nominal.py', 'not any(group.uses', 'True or not any(group.uses',
     'test_verdict_by_sensor.py::test_what_the_refused_sensor_would_correct_goes_as_well'),
    ('a refused sensor is as certain as a used one', 'calibration/nominal.py', 'np.diag(effect.prior_sds()**2)', 'np.diag(0 * effect.prior_sds()**2)',
     'test_verdict_by_sensor.py::test_the_covariance_of_what_is_left_alone_is_that_of_a_data_sheet'),
    ('a reason concerns both sensors', 'calibration/verdict.py', 'if sensor in reason.sensors]) for sensor', ']) for sensor', 'test_verdict_by_sensor.py::test_each_sensor_has_its_own_word_and_the_worst_is_that_of_both'),
    ('exports hold what compensation refuses', 'exports/export.py', 'else usable(calibration)', 'else Usable(calibration)',
     'test_verdict_by_sensor.py::test_other_programs_get_numbers_of_a_data_sheet_for_the_sensor_that_is_refused'),
    ('who corrects takes the refused sensor too', 'nodes/adoption.py', 'if settings.anyway else trust.usable(calibration)', 'if True else trust.usable(calibration)',
     'test_adoption.py'),
)
MUTANTS = (*NOISE, *COVARIANCE, *SEARCH, *BEYOND, *HAND, *TRUST, *FILES, *SIGNS, *LIVE, *BY_SENSOR)
