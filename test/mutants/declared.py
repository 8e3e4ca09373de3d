"""
Places that keep the tool from a false claim, each with a fault and the tests that must notice it.

See `mutants.mutation` for the patterns.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Mutant:
    """One fault."""

    name: str
    """What is broken, in a few words."""
    place: str
    """Qualified name of a function or constant."""
    pattern: str
    """Expression or statement that is there once."""
    fault: str
    """Replacement."""
    tests: tuple[str, ...]
    """Names of test files, or of single tests, that must notice; the quickest first."""


def _of(*mutants):
    """Return the mutants of (name, place, pattern, fault, tests)."""
    return tuple(Mutant(*fields, tests=tuple(tests.split())) for *fields, tests in mutants)


NOISE = _of(
    (
        'scatter from window to window dropped from weights',
        'NoiseModel.mean_variance',
        'self.low_variance',
        '0.001 * self.low_variance',
        'test_noise_model.py::test_means_scatter_by_the_noise_at_low_frequency_over_their_number',
    ),
    (
        'noise at low frequency taken for white',
        'NoiseModel.low_variance',
        'self.inflation',
        '1.0',
        'test_noise_model.py::test_means_scatter_by_the_noise_at_low_frequency_over_their_number',
    ),
    (
        'encoders have no steps where turns are read',
        'ReferenceNoise.of_steps',
        '_1 / np.sqrt(6)',
        '0.0 * _1',
        'test_search.py::test_a_turn_that_is_read_in_steps_leaves_more_in_the_mean_rate_than_the_sensor',
    ),
    (
        'biases stand still within windows',
        'means_beside_middles',
        'np.asarray(_1, float)',
        '0.0 * np.asarray(_1, float)',
        'test_noise_model.py::test_a_mean_over_a_window_differs_from_the_bias_in_its_middle_by_what_it_wanders',
    ),
    (
        'samples without noise are taken for exact',
        'white_noise',
        'LEAST_NOISE[_1] ** 2',
        '1e-30',
        'test_beyond_catalogue.py::test_a_recording_without_noise_is_judged_too',
    ),
    (
        'knocked rests enter the noise',
        'white_noise',
        '(_1[:, _2] <= 2 * _3) & (_1[:, _2] >= 0.5 * _3)',
        '_1[:, _2] > 0',
        'test_noise_model.py::test_a_knocked_rest_does_not_enter_the_noise',
    ),
    (
        'variance from few data taken for certain',
        'DOF_FACTOR_MOST',
        '...',
        '1.0',
        'test_noise_model.py::test_a_variance_from_few_data_is_taken_larger',
    ),
    (
        'slow misfit not weighed apart',
        'band_misfit',
        'MIN_VARIANCE_RATIO',
        'np.inf',
        'test_bands.py::test_a_wrong_gain_at_high_frequency_does_not_bend_the_estimate',
    ),
    (
        'caution about the slow misfit dropped',
        'CAUTIOUS_SDS',
        '2.0',
        '0.0',
        'test_bands.py::test_the_slow_misfit_of_few_pieces_is_taken_larger',
    ),
    (
        'correlated misfit along the columns not seen',
        'DESIGN_EIGENVALUE_SHARE',
        '1e-06',
        '2.0',
        'test_noise_model.py::test_misfit_along_the_columns_shows_how_correlated_it_is',
    ),
)
COVARIANCE = _of(
    (
        'prior of held parameters left out of the covariance',
        'covariance_with_held',
        '_1 @ np.diag(_2[_3] ** 2)',
        '0 * _1 @ np.diag(_2[_3] ** 2)',
        'test_estimation.py::test_undetermined_parameters_are_held_and_carried',
    ),
    (
        'nothing is ever held',
        'HELD_SHARE',
        '...',
        '5.0',
        'test_estimation.py::test_undetermined_parameters_are_held_and_carried',
    ),
    (
        'misfit does not widen standard deviations',
        'errors_of_waves',
        'np.sqrt(_1)',
        '1.0',
        'test_model_error.py::test_parts_that_ask_for_more_than_noise_explains_widen_by_half_more_than_they_show',
    ),
    (
        'drifts do not widen standard deviations',
        'errors_of_waves',
        '[chance for chance, _1 in drifts]',
        '[1.0]',
        'test_model_error.py::test_a_parameter_that_drifts_has_a_standard_deviation_that_repeats',
    ),
    (
        'standard deviations widen by chance',
        'CHANCE',
        '...',
        '0.9',
        'test_model_error.py::test_clean_sessions_stay_as_they_are',
    ),
    (
        'values that only misfit gives are believed',
        'implausible_parameters',
        '_1 > limit',
        '_1 < 0',
        'test_believing.py::test_a_scale_that_only_misfit_gives_is_held_and_named',
    ),
    (
        'a wrong full scale is taken for misfit',
        'implausible_parameters',
        '_1[_2] & (_3 > limit) & (_3 < _4[_2] * _5)',
        '_1[_2] & (_3 > limit)',
        'test_believing.py::test_a_wrong_full_scale_setting_is_no_misfit',
    ),
    (
        'unasked values do not shrink',
        'shrunk',
        '1.0',
        '0.0',
        'test_believing.py::test_what_nobody_asked_for_shrinks_and_what_is_plain_stays',
    ),
    (
        'unasked values vanish',
        'shrunk',
        'min(1.0, _1.sum() / max(_2, 1e-300))',
        '1.0',
        'test_believing.py::test_what_nobody_asked_for_shrinks_and_what_is_plain_stays',
    ),
)
SEARCH = _of(
    (
        'offsets of windows left out of the evidence',
        'mean_whitening',
        '_1 + _2.offset_sd ** 2',
        '_1',
        'test_search.py::test_offsets_of_windows_are_in_the_weights_of_the_evidence',
    ),
    (
        'gain judged on the windows that chose it',
        'heldout_gain',
        '_1.locked_samples',
        '_1.all_samples',
        'test_search.py::test_the_gain_is_that_of_locked_windows_by_the_measure_of_the_others',
    ),
    (
        'locked windows take part in the fit',
        'LinearisedProblem.__init__',
        '_1.select(~_2)',
        '_1',
        'test_diagnosis.py::test_what_locked_windows_show_moves_the_gain_and_nothing_else',
    ),
    (
        'locked windows show limits',
        'without_clipping',
        'windows_at(_1, _2 | ~_3)',
        '_1',
        'test_saturation.py::test_locked_windows_show_no_limit',
    ),
    (
        'a limit that one window alone shows is locked away',
        'without_clipping',
        '_1 | ~_2',
        '~_2',
        'test_saturation.py::test_a_limit_that_one_window_alone_shows_is_seen',
    ),
    (
        'cross-validation that leaks',
        'Evidence._left_by_others',
        'self.without[:, _1[:, None], _1]',
        'self.total[None, _1[:, None], _1] + 0 * self.without[:, _1[:, None], _1]',
        (
            'test_search.py::test_a_finding_predicts_what_it_was_not_fitted_to'
            ' test_search.py::test_noise_gains_nothing_where_it_was_not_fitted'
        ),
    ),
    (
        'interval of 50 % called 95 %',
        'reduction_interval',
        '(0.025, 0.975)',
        '(0.25, 0.75)',
        'test_search.py::test_an_interval_of_95_percent_holds_95_percent',
    ),
    (
        'correction for the number of effects dropped',
        'Search.score',
        'self.evidence.p_value(_1, _2) * len(self.questions)',
        'self.evidence.p_value(_1, _2)',
        'test_search.py::test_among_many_effects_one_is_significant_by_chance',
    ),
    (
        'significance of one in a thousand becomes 50 %',
        'FAMILY_WISE',
        '...',
        '0.5',
        'test_search.py::test_among_many_effects_one_is_significant_by_chance',
    ),
    (
        'gain on held-out windows not asked for',
        'Score.significant',
        (
            'self.allowed and self.p_value < FAMILY_WISE and (self.net > 0) and (self.gain >'
            ' MIN_GAIN_NATS)'
        ),
        'self.allowed and self.p_value < FAMILY_WISE',
        'test_search.py::test_a_finding_predicts_what_it_was_not_fitted_to',
    ),
    (
        'a negative time constant is allowed',
        'Search.allowed',
        '_1.effect.nonnegative and _2[0] < 0',
        'False',
        'test_search.py::test_no_lag_is_negative_no_angle_within_an_encoder_step_no_size_beyond_what_is_known',
    ),
    (
        'steps of the encoder pass for errors of the table',
        'least_angle',
        '0.5',
        '0.0',
        'test_search.py::test_no_lag_is_negative_no_angle_within_an_encoder_step_no_size_beyond_what_is_known',
    ),
    (
        'implausible sizes are explanations',
        'Search.allowed',
        'self.any_size or not self.implausible(_1, _2)',
        'True',
        'test_search.py::test_no_lag_is_negative_no_angle_within_an_encoder_step_no_size_beyond_what_is_known',
    ),
    (
        'earlier choices never reconsidered',
        'Search.run',
        'self.reconsidered([*_1, _2.question])',
        '[*_1, _2.question]',
        'test_search.py::test_an_earlier_choice_gives_way_to_what_explains_better_together',
    ),
    (
        'share of the unexplained that a finding must remove',
        'MIN_EXPLAINED_SHARE',
        '0.7',
        '0.1',
        'test_search.py::test_what_leaves_most_unexplained_is_not_named',
    ),
    (
        'the same for what is smooth in time',
        'MIN_SMOOTH_SHARE',
        '...',
        '0.1',
        'test_search.py::test_what_leaves_most_unexplained_is_not_named',
    ),
    (
        'a cause of the table need not show in both sensors',
        'Explained.share',
        'min',
        'max',
        'test_search.py::test_a_cause_of_the_table_shows_in_both_sensors',
    ),
    (
        'the quiet of two axes hides the third',
        'Explained._rest',
        'np.where(_1 > SIGNIFICANT_REST, _2, 0.0)',
        'np.where(_1 > 1000000000.0, _2, 0.0)',
        'test_search.py::test_what_one_axis_has_is_not_hidden_by_the_quiet_of_the_others',
    ),
    (
        'one of three axes costs no more than one',
        'ONE_OF_THREE',
        '...',
        '1.0',
        'test_search.py::test_what_one_axis_has_is_not_hidden_by_the_quiet_of_the_others',
    ),
    (
        'biases do not move by nature',
        'NATURAL',
        '...',
        '0.0',
        'test_search.py::test_every_bias_moves_by_half_the_white_noise_of_a_second',
    ),
    (
        'whatever a bias was found to do passes for noise',
        'PLAUSIBLE',
        '...',
        '800.0',
        'test_search.py::test_a_wander_that_was_found_passes_for_noise_as_far_as_biases_wander',
    ),
    (
        'a cable that pulls along one axis passes for noise',
        'MAX_MIDDLE_RATIO',
        '3.0',
        '300.0',
        'test_search.py::test_a_wander_that_was_found_passes_for_noise_as_far_as_biases_wander',
    ),
    (
        'offsets of windows cost nothing',
        'OFFSET_PRICE',
        '10.0',
        '0.0',
        'test_search.py::test_offsets_of_windows_have_their_price',
    ),
    (
        'a resolved lag is replaced and cannot come back',
        'Search._replaced',
        '_1.name in self.resolved',
        'False',
        'test_search.py::test_what_was_resolved_is_not_replaced',
    ),
    (
        'what is nothing without what was taken out is named',
        '_agreed',
        '_1.search.drop_insignificant(_that_help(_1, _3, _4) if _2 else _4)',
        '_that_help(_1, _3, _4) if _2 else _4',
        'test_search.py::test_what_is_nothing_without_what_was_taken_out_is_not_named',
    ),
    (
        'a lag that would be negative asks for no explanation',
        'Search.early',
        'replace(_1, allowed=True)',
        '_1',
        'test_search.py::test_a_lag_that_would_be_negative_is_no_finding_and_asks_for_an_explanation',
    ),
    (
        'lags that cost more than none explain',
        '_explanations',
        '_1.cost < _2',
        'True',
        'test_lag_explanations.py::test_what_costs_more_than_no_lag_explains_nothing',
    ),
    (
        'what no window tells of an effect is divided by',
        'WindowEvidence.p_value_by_scatter',
        'CONVENTION_SHARE * _1[-1]',
        '-1.0',
        'test_search.py::test_windows_agree_on_what_they_tell_of_an_effect',
    ),
    (
        'what replaces an effect may be chance',
        'Search._replaced',
        'self.score(_1, _2).significant',
        'True',
        'test_search.py::test_what_replaces_an_effect_is_significant_itself',
    ),
    (
        'a wander of any size costs nothing',
        'BiasProcessSearch.price',
        '(np.log(max(_1 / self.usual, 1.0)) / BIAS_LOG_SD) ** 2',
        '(np.log(max(_1 / self.usual, 1.0)) / BIAS_LOG_SD) ** 2 * 0.0',
        'test_search.py::test_a_wander_far_beyond_the_natural_one_has_its_price',
    ),
    (
        'a smooth effect need not beat the wander of the bias',
        'STRONG',
        '10.0',
        '-50.0',
        'test_search.py::test_what_is_smooth_in_time_has_to_beat_the_wander_of_the_bias',
    ),
    (
        'what a search starts from may be chance',
        'Search._dropped',
        'sorted(_1, key=...)',
        'sorted(_1 * (len(_1) > 1), key=...)',
        'test_search.py::test_what_a_search_starts_from_is_significant_by_itself_too',
    ),
    (
        'a bias that wanders within windows is a drift',
        '_join',
        'np.where(np.append(_1, False), 0.0, _2)',
        '_2.copy()',
        'test_search.py::test_within_windows_nothing_is_told_of_what_is_smooth_in_time',
    ),
    (
        'what a drift does within windows is left unexplained',
        'WindowEvidence._within_whole',
        'self.space.join',
        'self.space.join_within',
        'test_search.py::test_what_a_drift_does_within_windows_is_predicted_and_tells_nothing_of_it',
    ),
    (
        'how far windows agree is not asked',
        '_that_help',
        '_1.search.allowed(_2, _3) and _1.windows_agree(_2, _3)',
        '_1.search.allowed(_2, _3)',
        'test_search.py::test_what_the_windows_disagree_on_is_not_named',
    ),
    (
        'windows agree whatever they scatter',
        'WindowEvidence.p_value_by_scatter',
        '_1[:, list(_2)] @ (_3[:, _4] / _5)',
        (
            'np.pad(np.linalg.cholesky(_3[np.ix_(_4, _4)] / np.outer(_5, _5)).T, ((0, len(_1) -'
            ' len(_4)), (0, 0)))'
        ),
        'test_search.py::test_windows_agree_on_a_finding',
    ),
    (
        'all windows of a kind scatter alike',
        'mean_whitening',
        '_1 - 1',
        '0 * (_1 - 1)',
        'test_search.py::test_a_window_that_scatters_more_within_has_a_less_certain_mean',
    ),
    (
        'what only one window tells is held against it',
        'WindowEvidence.unpredicted',
        '(_1 * solve_scaled(_2, _1)).sum()',
        '0 * (_1 * solve_scaled(_2, _1)).sum()',
        'test_search.py::test_what_only_one_window_tells_is_not_held_against_it',
    ),
    (
        'a drift of a quiet instrument is asked for as of a consumer one',
        'drift_prior',
        'np.minimum',
        'np.maximum',
        'test_search.py::test_a_quiet_instrument_drifts_less',
    ),
    (
        'halves that disagree are not asked',
        '_agreed',
        'not _1.agrees_in_halves(_2, _3)',
        'False',
        'test_search.py::test_what_the_halves_disagree_on_is_denied',
    ),
    (
        'halves disagree by chance',
        'DISAGREE',
        '...',
        '0.5',
        'test_search.py::test_halves_agree_within_chance',
    ),
    (
        'a finding need not lower the residual in its own unit',
        '_that_help',
        '[not _1 > _needed_reduction(_2, _3, _4, _5) for _1, _5 in zip(_6, _4)]',
        '[False for _5 in _4]',
        (
            'test_search.py::test_a_finding_lowers_the_residual_in_the_sensors_own_unit'
            ' test_search.py::test_what_the_halves_disagree_on_is_denied'
        ),
    ),
    (
        'members of a pair imitate each other',
        'MIN_UNIQUE_SHARE',
        '0.05',
        '-1.0',
        'test_pairs.py::test_what_the_other_can_imitate_is_no_member',
    ),
    (
        'pairs may leave most of a rest',
        'LEFT',
        '...',
        '1.0',
        'test_pairs.py::test_pairs_are_tested_for_a_remaining_excess',
    ),
    (
        'another look where nothing is left',
        '_looked_again',
        'not _1.rest',
        'False',
        'test_pairs.py::test_pairs_are_tested_for_a_remaining_excess',
    ),
    (
        'limits need not agree with the motion',
        'AGREEMENT',
        '...',
        '0.0',
        'test_saturation.py::test_a_limit_is_where_the_motion_passes_it',
    ),
    (
        'coarse outputs pass for clipped ones',
        'may_be_clipped',
        'bool(_1 > 3 * _2[-5:].max(initial=1))',
        'True',
        'test_saturation.py::test_gravity_on_the_highest_steps_of_a_coarse_output_is_no_limit',
    ),
    (
        'clipped samples stay',
        'without_clipped',
        '_1 | _2',
        '_1 & ~_1 | _2 & ~_2',
        'test_saturation.py::test_samples_at_a_limit_and_those_predicted_near_it_are_left_out',
    ),
)
BEYOND = _of(
    (
        'threshold of what is unexplained',
        'SIGNIFICANT_SDS',
        '5.0',
        '50.0',
        'test_search.py::test_a_rest_of_some_standard_deviations_is_unexplained',
    ),
    (
        'any correlation is told',
        'correlate',
        '_1 < ALPHA and _2 > max(_3[1], 0.15)',
        '_2 > _3[1]',
        'test_search.py::test_noise_goes_with_nothing',
    ),
    (
        'a line of few stretches is a tone',
        'of_stretches',
        (
            'np.where(_1 > MOSTLY * _2[:, None], binom_sf(_1 - 1, _2[:, None], LINE_CHANCE) * ...,'
            ' 1.0)'
        ),
        'np.where(_1 > 0, 0 * binom_sf(_1 - 1, _2[:, None], LINE_CHANCE) * ..., 1.0)',
        'test_spectrum.py',
    ),
    (
        'a rest does not make biases less certain',
        'biases_off',
        '_1.significant',
        'False',
        'test_by_evidence.py::test_what_a_rest_may_move_biases_by',
    ),
    (
        'formulas of a temperature that stays',
        'RestBlocks.warms',
        (
            'self.ref.temperature_c is not None and bool(np.ptp(self.ref.temperature_c) >='
            ' TEMPERATURE_SPAN)'
        ),
        'self.ref.temperature_c is not None',
        'test_beyond_catalogue.py::test_a_temperature_that_stays_is_no_cause',
    ),
    (
        'formulas of the sense of a rate at rest',
        '_sense',
        "_1.startswith('w')",
        'False',
        'test_beyond_catalogue.py::test_the_sense_of_a_rate_is_not_that_of_the_rate_of_the_earth',
    ),
    (
        'a finding that a formula does without stays',
        '_done_without',
        'sum(_1.values()) < NOT_NEEDED * sum(_2.values())',
        'False',
        'test_beyond_catalogue.py',
    ),
    ('a gradual change is an onset', 'SUDDEN', '...', '-1e9', 'test_onset.py'),
    (
        'the time of a step is moved to its prior',
        'SensorModel.prior',
        '_1.located',
        'False',
        'test_onset.py',
    ),
    (
        'a place is known to its bins only',
        'RegimeSearch._refined',
        '(0, 1)',
        '()',
        'test_regimes.py',
    ),
    ('a place need not be better than a smooth curve', 'SURE', '16.0', '-1e9', 'test_regimes.py'),
    ('an axis of noise carries a rest', 'ABOVE_NOISE', '...', '0.0', 'test_regimes.py'),
    (
        'scatter of one sensor passes for errors of the stamps',
        'stamp_jitter',
        'max(min(np.average(_1, weights=1 / _2 ** 2), *(_1 + BOUND_SDS * _2)), 0.0)',
        'max(np.average(_1, weights=1 / _2 ** 2), 0.0)',
        'test_stamp_jitter.py::test_scatter_of_one_sensor_is_no_error_of_the_stamps',
    ),
    (
        'scatter by the stamps counts as an incomplete model',
        'misfit_ratios',
        '_1 / _2.get(_3, 1.0)',
        '_1',
        'test_stamp_jitter.py::test_a_calibration_does_not_call_scatter_by_the_stamps_an_incomplete_model',
    ),
    ('of what scatters the whole range is told', 'NEARLY_ALL', '...', '1.0', 'test_regimes.py'),
    (
        'a place is no reason to withdraw a name',
        '_places',
        'np.stack([_1.get(_2, _3) for _2 in AXES], axis=1)[:, None].astype(float) if _1 else None',
        'None',
        'test_beyond_catalogue.py',
    ),
    (
        'calibrate adopts what a formula does without',
        'without_superseded',
        '_1.named',
        'False',
        'test_by_evidence.py::test_calibrate_does_not_adopt_what_diagnose_withdraws',
    ),
    (
        'a finding goes for any formula',
        '_done_without',
        'sum(_1.values()) < NOT_NEEDED * sum(_2.values())',
        'True',
        'test_beyond_catalogue.py',
    ),
)
HAND = _of(
    (
        'gravity enters the gyroscope by chance',
        'shown',
        "_1['g_sensitivity_p_value'] < G_SENSITIVITY_P_VALUE",
        "_1['g_sensitivity_p_value'] < 0.9",
        (
            'test_hand_faults.py::test_a_warm_up_is_not_sold_as_g_sensitivity'
            ' test_hand_faults.py::test_a_drift_is_not_named_g_sensitivity_if_attitudes_are_sorted'
            ' test_by_hand.py'
        ),
    ),
    (
        'time is not asked beside gravity',
        'g_sensitivity_evidence',
        '[np.ones(_1), _2, _2 ** 2][:3 if _1 >= 12 else 2]',
        '[np.ones(_1)]',
        (
            'test_hand_faults.py::test_a_warm_up_is_not_sold_as_g_sensitivity'
            ' test_hand_faults.py::test_a_drift_is_not_named_g_sensitivity_if_attitudes_are_sorted'
        ),
    ),
    (
        'the Earth answers to gravity',
        'g_sensitivity_evidence',
        'np.clip(_1, -EARTH_RATE, EARTH_RATE)',
        'np.clip(_1, 0, 0)',
        'test_hand_faults.py::test_the_earth_is_not_sold_as_g_sensitivity',
    ),
    (
        'what is held is asked for by other names',
        'investigate_by_hand',
        '_1.hand_model.size + 1',
        '12',
        'test_diagnosis_by_hand.py::test_what_held_parameters_may_be_is_no_finding',
    ),
    (
        'drifts do not widen sds by hand',
        'with_movement',
        '(_1.size / 2) ** 2',
        '0',
        'test_hand_faults.py::test_biases_that_drift_carry_it_in_their_sd_and_a_note_with_its_size',
    ),
    (
        'a place may come by chance',
        'RegimeSearch.offsets',
        '_1 > level',
        'False',
        'test_diagnosis_by_hand.py::test_a_place_among_few_poses_is_paid_for',
    ),
    (
        'a hysteresis is asked where it warms up only',
        'BRANCHES_APART',
        '...',
        '0.0',
        'test_thermal_branch.py::test_it_is_asked_only_where_the_temperature_turned',
    ),
    (
        'a rectification is asked where nothing vibrates',
        '_why_not',
        "'vibration' in _1.needs and (not _2)",
        'False',
        'test_vibration.py::test_it_is_asked_only_where_rests_vibrate_unlike',
    ),
    (
        'a hand passes for vibration',
        'quiet_beside_joints',
        '_1 & _steady(_2, ratio=_3, resting=_4)',
        '_steady(_2, ratio=_3, resting=_4)',
        'test_windows.py::test_a_vibrating_table_rests_while_its_joints_rest_and_a_moved_or_knocked_one_does_not',
    ),
    (
        'a knock passes for vibration',
        '_steady',
        '_1 ** 2 * _2',
        'np.inf',
        'test_windows.py::test_a_vibrating_table_rests_while_its_joints_rest_and_a_moved_or_knocked_one_does_not',
    ),
    (
        'a vibration is the noise of all rests',
        '_usual',
        'float(np.median(_1[_2])) < MIN_INFLATION',
        'False',
        'test_vibration.py::test_rests_that_vibrate_do_not_make_the_noise_of_the_quiet_ones',
    ),
    (
        'vibration is not followed live',
        'SampleCompensation.correct',
        'self._shakes',
        'False',
        'test_vibration.py::test_compensation_live_and_of_a_recording_take_the_rectification_out',
    ),
    (
        'what comes after a turn is on the old branch',
        'SampleCompensation.set_temperature',
        'self.branch.push(_1)',
        'pass',
        'test_thermal_branch.py::test_compensation_live_and_of_a_recording_take_the_branch_out',
    ),
    (
        'what does not belong to the others stays',
        'without_outlying_poses',
        '_1 * len(_2) < OUTLIER_P_VALUE',
        '_1 < 0',
        'test_hand_faults.py::test_a_pose_a_rest_and_a_turn_that_were_disturbed_are_left_out',
    ),
    (
        'missed turns stay',
        'CONTRADICTED',
        '...',
        '9.0',
        'test_hand_faults.py::test_what_was_left_out_does_not_come_back_in_the_proof',
    ),
    (
        'slow turns are poses',
        '_not_turning',
        '_1[1:-1] &= np.all(_2 <= np.maximum(_SCATTERS * _3, _4), axis=1)',
        '_1[1:-1] |= np.all(_2 <= np.maximum(_SCATTERS * _3, _4), axis=1)',
        'test_hand_faults.py::test_a_slow_turn_about_the_vertical_is_no_pose',
    ),
    ('spikes stay', 'LARGE', '...', '8000000000.0', 'test_spike_filter.py'),
    (
        'knocks pass for spikes',
        'SHARED',
        '...',
        '1.5e9',
        'test_spike_filter.py::test_knocks_of_one_reading_that_reach_several_axes_stay',
    ),
    (
        'fast motion passes for spikes',
        '_contradicted',
        '_1 < PREDICTION_SHARE * _2 + PREDICTION_MARGIN * _3',
        'True',
        'test_spike_filter.py',
    ),
    (
        'rests reach into the turns',
        '_LEAVES',
        '...',
        '5e5',
        'test_still_search.py::test_rests_end_where_the_turn_begins_even_in_vibration',
    ),
    (
        'by hand, turns are integrated over jittering stamps',
        'UNDECIDED',
        '...',
        '0.0',
        'test_hand_faults.py::test_times_are_those_of_the_clock_that_jittering_stamps_follow',
    ),
)
ALLAN = _of(
    (
        'white noise lost behind a vibration',
        '_fit_range',
        '_1 and _2.misfit / _3 < _4',
        'True and _2.misfit / _3 < _4',
        'test_noise_identification.py::test_a_vibration_does_not_hide_the_white_noise',
    ),
    (
        'forms told apart by what none explains',
        'log_cost',
        'float(_1 @ _1) / _2',
        'float(_1 @ _1)',
        'test_noise_identification.py::test_forms_of_a_curve_that_none_explains_are_told_apart_less',
    ),
)
TRUST = _of(
    ('harmful sensors are corrected', 'refused_sensors', '_1 and not _2', 'True', 'test_trust.py'),
    (
        'unproven sensors are corrected live',
        'refused_sensors',
        '_1 or not _2',
        'True',
        'test_trust.py',
    ),
    (
        'the decision in the file hides the proof',
        'Calibration.decisions',
        'self.proof.get(_1) or not _2',
        'not _2',
        'test_trust.py',
    ),
    (
        'a calibration for another sensor is taken',
        '_require_same_frame',
        '_1.frame_id != _2',
        'False',
        'test_adoption.py',
    ),
    (
        'whatever a document does ends the node',
        'adopt',
        'Exception',
        'ZeroDivisionError',
        'test_adoption.py',
    ),
    ('help that is not shown counts as help', 'decide', 'high < 1.0', 'low < 1.0', 'test_trust.py'),
    ('harm in some motion is passed over', 'harmed', 'HARM', '99', 'test_proof.py test_verdict.py'),
    (
        'proof on windows that were fitted',
        'HeldOut.values_without',
        '(_1 for _2, _1 in enumerate(_3) if _2 != _4)',
        '(_1 for _2, _1 in enumerate(_3))',
        'test_proof.py::test_a_fold_is_left_out_as_if_it_had_not_been_recorded',
    ),
    (
        'the mount that bends goes from one side of the proof',
        'not_applied',
        '_1.sensor in SENSORS',
        'True',
        'test_proof.py::test_both_sides_are_compared_with_the_same_table',
    ),
    (
        'effects that are not applied count from zero',
        'applied_values',
        'centred(_1, _2, _3 or {})[0]',
        '_2.copy()',
        'test_applied.py',
    ),
    (
        'one significant coefficient is not required',
        'one_significant',
        'np.any(np.abs(_1) > MIN_COEFFICIENT_SDS * _2)',
        'True',
        'test_by_evidence.py::test_an_effect_that_is_no_more_than_chance_with_honest_standard_deviations_is_left_out',
    ),
    ('effects in time are proven on all windows', 'LAST_SHARE', '...', '0.0', 'test_applied.py'),
    (
        'check corrects with the readings of the reference',
        '_both',
        '_1[:, :3]',
        'window.force_s',
        'test_applied.py',
    ),
    ('misfit is not a reason', 'MAX_MISFIT_RATIO', '10.0', '1000000000.0', 'test_verdict.py'),
    ('weak called determined', 'statuses', '_1 <= _2', '_1 <= 9 * _2', 'test_status.py'),
    ('held called determined', 'statuses', 'HELD', 'DETERMINED', 'test_status.py'),
    ('weak values are kept', 'replace_weak', '_1[_2] >= 1.0', 'True', 'test_covariance_terms.py'),
    (
        'the shift of a replaced value is not in its sd',
        'replace_weak',
        'with_term(_1, HELD_PRIORS, np.outer(_2 - _3, _2 - _3))',
        'dict(_1)',
        'test_covariance_terms.py',
    ),
)
FILES = _of(
    (
        'files written where they stand',
        '_beside',
        '_1.parent / f".{os.getpid()}.{token_hex(8)}.{_ending(_1)}"',
        '_1',
        'test_disk_faults.py test_cli_bad_input.py',
    ),
    (
        'comments that end at a line end of a name',
        'commented',
        'printable(_1)',
        '_1',
        'test_exports.py',
    ),
    (
        'names of recordings as they come',
        'clean_name',
        "printable(_1[:LONGEST_NAME].decode(errors='replace'))",
        "_1[:LONGEST_NAME].decode(errors='replace')",
        'test_adapters_cdr.py',
    ),
    (
        'paths of nodes that anybody can change',
        'parameter_descriptor',
        '_1.path',
        'False',
        'test_calibration_attacked.py test_compensator_attacked.py',
    ),
    (
        'columns that grow without limit',
        'LONGEST_EXPANDED',
        '5000',
        '10 ** 9',
        'test_hostile_documents.py',
    ),
    ('no limit to nesting', 'MAX_DOCUMENT_DEPTH', '20', '10 ** 9', 'test_documents.py'),
    (
        'aliases allowed',
        '_look_through',
        "_1 == 'AliasEvent' and (not (_2 and _3.anchor in _4))",
        'False',
        'test_documents.py',
    ),
    (
        'another model is resumed',
        'require_columns',
        'not _1.has_columns_of(_2)',
        'False',
        'test_session_files.py test_live_calibration.py',
    ),
    (
        'another temperature is resumed',
        'SensorModel.has_columns_of',
        "('joint_names', 'temperature_ref_c', 'definitions')",
        "('joint_names', 'definitions')",
        'test_live_calibration.py test_session_files.py',
    ),
)
SIGNS = _of(
    (
        'saturated rates read as a frozen joint',
        '_unsaturated',
        'not _1.any()',
        'True',
        'test_joint_geometry.py',
    ),
    (
        'another latitude reads as a g-sensitivity',
        'latitude_findings',
        '_1.azimuth_deg is not None and _2 is not None',
        'False',
        'test_latitude_check.py',
    ),
    (
        'a turned IMU reads as a frozen joint',
        'standing_still',
        '_1 is not None',
        'False',
        'test_joint_geometry.py',
    ),
    (
        'axes between coordinate axes are not tried',
        'standing_still',
        'is_unexplained(_1, _2)',
        'False',
        'test_joint_geometry.py',
    ),
    (
        'mount that fits of the inverse turn',
        'mount_rpy_deg',
        '(nearest_rotation(_1) @ _2.mat_sl).T',
        'nearest_rotation(_1) @ _2.mat_sl',
        'test_mount_check.py',
    ),
    (
        'sensors turned differently read as a turned IMU',
        'common_turn',
        '_1 <= LARGEST_DIFFERENCE * np.linalg.norm(_2) / 2',
        'True',
        'test_mount_check.py',
    ),
    (
        'angles between axes do not limit a common turn',
        'common_turn',
        'squares += float(_1 @ _1)',
        'pass',
        'test_mount_check.py',
    ),
    (
        'another latitude of the same sign is not noted',
        '_severity',
        '_contradicts(_1, _2, NAMED_SDS)',
        'False',
        'test_latitude_check.py',
    ),
    (
        'notes about the result are not shown',
        'visible_findings',
        'finding.severity == NOTE and finding.check not in DESCRIPTIVE',
        'False',
        'test_table_errors.py',
    ),
    (
        'centripetal term with the other sign',
        'lever_matrix',
        'skew(_1) + _2 @ _2',
        'skew(_1) - _2 @ _2',
        'test_zhang.py test_physics_and_catalogue.py',
    ),
    (
        'tangential term with the other sign',
        'lever_matrix',
        'skew(_1) + _2 @ _2',
        '-skew(_1) + _2 @ _2',
        'test_zhang.py test_physics_and_catalogue.py',
    ),
    (
        'parameters left out of the published covariance',
        'Sensitivity.covariances',
        '_1 + self.parameters[_2:_2 + 3, _2:_2 + 3]',
        '_1 + _1 * 0',
        'test_compensation_covariance.py',
    ),
    (
        'unknown angular acceleration left out of the published covariance',
        'RateSlope._error',
        'replace(self._size_of_all(_1), weights=np.zeros(1))',
        'SlopeError()',
        'test_covariance_of_a_new_slope.py',
    ),
    (
        'motion that the rates exclude kept in the published covariance',
        'SlopeError.covariance',
        'self.evidence.chance_of_motion(_1) * _2',
        '_2',
        'test_covariance_of_a_new_slope.py',
    ),
    (
        'delay of the derivative left out of the published covariance',
        'Sensitivity.covariances',
        'self.earlier * _1 + _2',
        'self.earlier * _1',
        'test_compensation_covariance.py test_rate_slope.py',
    ),
    (
        'bias added instead of taken away',
        '_Part.__init__',
        '-_1',
        '_1',
        'test_compensation_kernel.py',
    ),
)
LIVE = _of(
    (
        'a swing goes beyond the end of its joint',
        'MotionLibrary._swing',
        '0.48 * (_1 - _2)',
        '0.52 * (_1 - _2)',
        'test_planning_motions.py',
    ),
    (
        'a motion begins while the joints move',
        'Driver.begin',
        'not self.rests',
        'False',
        'test_driving.py',
    ),
    (
        'joints rest as soon as they are started',
        'Driver.start',
        'self._slow, self._rested_at = (True, None)',
        'self._slow = True',
        'test_driving.py',
    ),
    (
        'a motion begins while the stopped one may still come',
        'Driver.stop',
        'self.state is DriveState.MOVING',
        'False',
        'test_driving.py',
    ),
    (
        'a stop is taken by one clock alone',
        'Driver.awaits_stop',
        'min(self._time - self._stopped[0], self._heard - self._stopped[1])',
        'self._time - self._stopped[0]',
        'test_driving.py',
    ),
    (
        'a stall is told by one clock alone',
        'PathWatch.has_stalled_for',
        'min(self.waited, self._now - self._further)',
        'self.waited',
        'test_driving.py',
    ),
    (
        'a stall is counted from where nothing had moved',
        'PathWatch.observe',
        'self.waited == 0.0',
        'self._further == 0.0',
        'test_driving.py',
    ),
    (
        'a stop is awaited by a clock that was set back',
        'Driver.observe',
        'self._stopped = (_1, _2)',
        'pass',
        'test_driving.py',
    ),
    (
        'a late controller is called restless',
        'PlannerWorker._wait_for_rest',
        'self.driver.awaits_stop',
        'False',
        'test_planner_node.py::test_the_worker_waits_until_the_joints_rest_and_not_for_ever',
    ),
    (
        'silent joints are waited for without end',
        'PlannerWorker._wait_for_rest',
        'self.driver.awaits_stop and (not self.driver.is_silent(time.monotonic()))',
        'self.driver.awaits_stop',
        'test_planner_node.py::test_the_worker_waits_until_the_joints_rest_and_not_for_ever',
    ),
    (
        'a clock set back counts as rest for ever',
        'Driver._note_rest',
        (
            'self._rested_at is None or self._time < self._rested_since or'
            ' np.any(np.abs(self.position - self._rested_at) > MAX_REST_MOVEMENT * self.tolerance)'
        ),
        (
            'self._rested_at is None or np.any(np.abs(self.position - self._rested_at) >'
            ' MAX_REST_MOVEMENT * self.tolerance)'
        ),
        'test_driving.py',
    ),
    (
        'nobody waits until the joints rest',
        'PlannerWorker._wait_for_rest',
        'not self.driver.rests',
        'False',
        'test_planner_node.py::test_the_worker_waits_until_the_joints_rest_and_not_for_ever',
    ),
    (
        'frozen stamps go on for ever',
        'Driver.observe',
        'self.is_driving and (_1 := self.stamp_fault(_2))',
        'False',
        'test_planner_attacked.py::test_stamps_that_stand_still_are_a_fault_within_the_silence',
    ),
    (
        'a position that is not finite counts',
        'Driver.observe',
        'not np.all(np.isfinite(_1))',
        'False',
        'test_planner_attacked.py::test_positions_that_are_not_finite_are_ignored_and_counted_by_joint',
    ),
    (
        'an endless joint turns on and on',
        'MotionLimits.wound',
        'np.where(self.endless, 2 * np.pi * _1, np.inf)',
        'np.full(len(self), np.inf)',
        'test_joint_ranges.py',
    ),
    (
        'joint states wait in line',
        'BatchInput._arrived',
        'self.drain()',
        'False',
        'test_planner_node.py::test_joint_states_that_came_while_it_was_busy_are_all_taken_at_once',
    ),
    (
        'a node without work is not woken to end',
        'run_node',
        'every(_1, LOOK_AGAIN, lambda: None)',
        'pass',
        'test_node_ends.py',
    ),
    (
        'its own work taken for silence of the sensor',
        'CalibrationWorker._tell',
        'self._watch.state(self._looked, self.live.stamping)',
        'self._watch.state(time.monotonic(), self.live.stamping)',
        'test_calibration_worker.py',
    ),
    (
        'its own work taken for the end of the motion',
        'CalibrationWorker._solve_when_due',
        'self._looked',
        'time.monotonic()',
        'test_calibration_worker.py',
    ),
    (
        'an open window counts twice',
        'LiveCalibration.solve',
        '_1.snapshot(_2)',
        '_1.snapshot(True)',
        'test_live_calibration.py::test_windows_that_are_open_count_only_when_asked_for',
    ),
    (
        'what is found live never joins the model',
        'LiveCalibration.adopt',
        '_1.take_model(_2)',
        'pass',
        'test_live_diagnosis.py::test_a_resumed_session_keeps_what_joined',
    ),
    (
        'the model as asked grows live',
        'LiveCalibration.adopt',
        (
            '_1 is None or self.last is None or self.options.as_asked or (_2.is_nothing and'
            ' self.extension.is_nothing)'
        ),
        '_1 is None or self.last is None or (_2.is_nothing and self.extension.is_nothing)',
        'test_live_diagnosis.py::test_the_model_as_asked_stays',
    ),
    (
        'windows that are gone are taken anew',
        'LiveSnapshot.evidence',
        'self.store.complete',
        'True',
        'test_live_diagnosis.py::test_what_cannot_join_is_said_and_widens',
    ),
    (
        'a resumed session forgets what joined',
        'LiveCalibration.__init__',
        '_1.as_asked',
        'True',
        'test_live_diagnosis.py::test_a_resumed_session_keeps_what_joined',
    ),
    (
        'what is denied live does not widen',
        'LiveCalibration.solve',
        'self.extension.applied(_1.solution)',
        '_1.solution',
        'test_live_diagnosis.py::test_what_cannot_join_is_said_and_widens',
    ),
    (
        'whoever saves does not wait for the answer',
        'DiagnosisThread.settle',
        '_1 is not None and self.period and (_1.samples != self._answered)',
        'False and (_1.samples != self._answered)',
        'test_live_diagnosis.py::test_who_saves_waits_for_the_answer_and_asks_the_same_once',
    ),
    (
        'an earlier run is forgotten',
        'LiveCalibration._with_earlier',
        'merge([copied(self.earlier), _1])',
        '_1',
        'test_live_calibration.py::test_a_session_resumed_from_its_state_equals_two_recordings',
    ),
    (
        'solving again adds the earlier run again',
        'LiveCalibration._with_earlier',
        'copied(self.earlier)',
        'self.earlier',
        'test_live_calibration.py::test_a_session_resumed_from_its_state_equals_two_recordings',
    ),
)
BY_SENSOR = _of(
    (
        'by hand the gyroscope is used beside a refused accelerometer',
        'refused_sensors',
        "_1.gauge.get('axes') == HAND_AXES",
        'False',
        'test_trust.py::test_by_hand_the_gyroscope_is_not_applied_without_the_accelerometer',
    ),
    (
        'what a refused sensor reads still corrects the other one',
        '_stays',
        (
            "_1.sensor == 'reference' or not any((_2.uses & READINGS[_3] for _3 in _4 for _2 in"
            ' _1.groups))'
        ),
        (
            "_1.sensor == 'reference' or True or (not any((_2.uses & READINGS[_3] for _3 in _4 for"
            ' _2 in _1.groups)))'
        ),
        'test_verdict_by_sensor.py::test_what_the_refused_sensor_would_correct_goes_as_well',
    ),
    (
        'a refused sensor is as certain as a used one',
        'with_nominal',
        '_1.prior_sds() ** 2',
        '0 * _1.prior_sds() ** 2',
        'test_verdict_by_sensor.py::test_the_covariance_of_what_is_left_alone_is_that_of_a_data_sheet',
    ),
    (
        'both sensors have the proof of one',
        '_decisions',
        '_1.proof.get(_2)',
        "_1.proof.get('gyroscope')",
        'test_verdict_by_sensor.py::test_each_sensor_has_its_own_decision',
    ),
    (
        'exports hold what compensation refuses',
        'export',
        'usable(_1, anyway=_2)',
        'Usable(_1)',
        'test_verdict_by_sensor.py::test_other_programs_get_nominal_numbers_for_the_sensor_that_is_refused',
    ),
    ('who corrects takes the refused sensor too', 'adopt', '_1.anyway', 'True', 'test_adoption.py'),
    (
        'many small changes from the topic add up',
        '_anchor_from_topic',
        '[_1.used.calibration, _1.anchor]',
        '[_1.used.calibration]',
        'test_adoption.py::test_many_small_changes_from_the_topic_do_not_add_up',
    ),
)
MUTANTS = (
    *NOISE,
    *COVARIANCE,
    *SEARCH,
    *BEYOND,
    *HAND,
    *ALLAN,
    *TRUST,
    *FILES,
    *SIGNS,
    *LIVE,
    *BY_SENSOR,
)
