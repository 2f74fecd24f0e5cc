# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The page of an evaluation in a browser: a click on a point shows its image and keyframe."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from cylinder_worlds import SMALL_RECIPE

from sfa_localization.bags.settings import TopicNames
from sfa_localization.cli import main
from sfa_localization.evaluation import evaluate
from sfa_localization.reports.evaluation import write_evaluation_page
from sfa_localization.reports.moments import moments_of
from sfa_localization.reports.page import PAGE
from sfa_localization.reports.plots import SCRIPT, curves_of

DEADLINE_S = 120
"""For a page, on a machine that does other things."""
BROWSERS = 'chromium', 'chromium-browser', 'google-chrome'
LARGEST = 1_500_000
CARD = """
const card = document.querySelector('.moment:not([hidden])');
return {stamp: card.dataset.stamp, text: card.innerText, shown: [...card.querySelectorAll('img')]
  .map(image => [image.alt, image.naturalWidth, image.clientWidth]),
  cards: document.querySelectorAll('.moment:not([hidden])').length};"""
# The pixel, in the window, of the point of a trace that is farthest from points of other times; and
# its time.
PIXEL = """
const [number, name] = arguments, plot = document.querySelectorAll('.js-plotly-plot')[number];
plot.scrollIntoView({block: 'center'});
const {xaxis, yaxis} = plot._fullLayout, box = plot.getBoundingClientRect();
const points = plot.data.flatMap((trace, k) => trace.customdata && (trace.yaxis || 'y') === 'y'
  ? trace.customdata.map((time, at) => ({name: trace.name, time,
      x: box.x + xaxis._offset + xaxis.l2p(plot.calcdata[k][at].x),
      y: box.y + yaxis._offset + yaxis.l2p(plot.calcdata[k][at].y)})) : []);
const away = one => Math.min(...points.filter(other => Math.abs(other.time - one.time) > 0.1)
  .map(other => Math.hypot(other.x - one.x, other.y - one.y)));
const own = points.filter(one => one.name === name);
const best = own.reduce((one, other) => away(other) > away(one) ? other : one);
return [best.x, best.y, best.time];"""
MARKED = """
return [...document.querySelectorAll('.js-plotly-plot')].flatMap(plot => plot.data
  .filter(one => one.customdata).map(one => one.customdata[(one.selectedpoints || [-1])[0]]));"""
TEXTS = """
const lightness = color => color.match(/[\\d.]+/g).slice(0, 3).reduce((sum, c) => sum + +c, 0) / 3;
const back = lightness(getComputedStyle(document.body).backgroundColor);
return [...document.querySelectorAll('.js-plotly-plot text')]
  .filter(one => one.textContent.trim() && !one.closest('.hoverlayer')).map(
  one => [one.textContent, Math.abs(lightness(getComputedStyle(one).fill) - back)]);"""


@pytest.fixture(scope='module')
def browser():
    """Chromium without a window."""
    webdriver = pytest.importorskip('selenium.webdriver')
    found, driver = [*filter(None, map(shutil.which, BROWSERS))], shutil.which('chromedriver')
    if not (found and driver):
        pytest.skip(f'needs one of {", ".join(BROWSERS)}, and chromedriver: apt install chromium')
    options = webdriver.ChromeOptions()
    options.binary_location = found[0]
    # Containers run as root, and have little shared memory.
    for word in ('--headless=new', '--no-sandbox', '--disable-dev-shm-usage', '--disable-gpu'):
        options.add_argument(word)
    options.set_capability('goog:loggingPrefs', {'browser': 'ALL'})
    opened = webdriver.Chrome(options, webdriver.ChromeService(driver))
    opened.set_page_load_timeout(DEADLINE_S)
    opened.set_script_timeout(DEADLINE_S)
    yield opened
    opened.quit()


@pytest.fixture(scope='module')
def evaluated(trained, tmp_path_factory):
    """An evaluation, its page, and what it shows."""
    model, folder = trained.result.model, tmp_path_factory.mktemp('evaluated')
    recipe = replace(SMALL_RECIPE, topics=TopicNames(ground_truth='/odom'))
    result = evaluate(model, trained.bag, recipe=recipe)
    features = result.estimates['sfa'].poses[:, :2], result.features
    write_evaluation_page(folder, 'a drive', result, model, features)
    return folder, result, moments_of(result, model)


def open_page(browser, folder, width, scheme):
    """Open a page at a width in pixels, in the light or in the dark."""
    scheme = {'name': 'prefers-color-scheme', 'value': scheme}
    browser.execute_cdp_cmd('Emulation.setEmulatedMedia', {'features': [scheme]})
    size = {'width': width, 'height': 900, 'deviceScaleFactor': 1, 'mobile': width < 500}
    browser.execute_cdp_cmd('Emulation.setDeviceMetricsOverride', size)
    browser.get((folder / PAGE).as_uri())
    assert browser.execute_script('return document.documentElement.scrollWidth') <= width
    assert not [entry for entry in browser.get_log('browser') if entry['level'] == 'SEVERE']


def click(browser, number, name):
    """Click a point of a curve in one of the plots; return its time, s."""
    x, y, seconds = browser.execute_script(PIXEL, number, name)
    mouse = {'x': x, 'y': y, 'button': 'left', 'clickCount': 1}
    for kind in ('mouseMoved', 'mousePressed', 'mouseReleased'):
        browser.execute_cdp_cmd('Input.dispatchMouseEvent', {'type': kind, **mouse})
    return seconds


def wait_for(browser, condition):
    """Wait until a function of the browser is true."""
    from selenium.webdriver.support.ui import WebDriverWait

    WebDriverWait(browser, DEADLINE_S).until(condition)


@pytest.mark.parametrize(
    ('width', 'scheme'), [(1280, 'light'), (1280, 'dark'), (390, 'light'), (390, 'dark')]
)
def test_a_click_on_a_point_shows_its_image_and_its_keyframe(width, scheme, browser, evaluated):
    """In the plot of the path, in that of the errors, by a button, and by the slider."""
    folder, _, moments = evaluated
    open_page(browser, folder, width, scheme)
    for number, name in ((0, 'images'), (1, 'SFA, one image each')):
        seconds = click(browser, number, name)
        moment = min(moments, key=lambda one, at=seconds: abs(one.seconds - at))
        wait_for(browser, lambda _, at=moment: shown(browser)['stamp'] == str(at.stamp_ns))
        card = shown(browser)
        assert card['cards'] == 1 and f'at {moment.seconds:.2f} s' in card['text']
        assert card['shown'][2][0].startswith(f'Likest keyframe, number {moment.match.row}: ')
        assert all(natural > 0 and drawn > 250 for _, natural, drawn in card['shown'])
        assert f'{moment.truth[0]:.2f}' in card['text'] and 'filter' in card['text']
        assert f'{moment.single.pose[0]:.2f} ± ' in card['text']
        marked = np.array(browser.execute_script(MARKED))
        assert len(marked) > 6 and np.abs(marked - seconds).max() < 0.2, 'in all plots'
    texts = browser.execute_script(TEXTS)
    assert len(texts) > 20 and all(away > 90 for _, away in texts), 'not legible'


def shown(browser):
    """The card that is shown."""
    return browser.execute_script(CARD)


def test_the_slider_and_the_buttons_of_the_worst_images(browser, evaluated):
    folder, _, moments = evaluated
    open_page(browser, folder, 1280, 'light')
    marked = np.array(browser.execute_script(MARKED))
    assert np.abs(marked - moments[0].seconds).max() < 2.0, 'the first image, from the start'
    move = (
        "const slider = document.querySelector('#moment'); slider.value = arguments[0];"
        "slider.dispatchEvent(new Event('input'));"
    )
    browser.execute_script(move, 33)
    assert shown(browser)['stamp'] == str(moments[33].stamp_ns)
    browser.execute_script("document.querySelector('button.at').click()")
    worst = max(moments, key=lambda moment: moment.error_m(moment.single))
    assert shown(browser)['stamp'] == str(worst.stamp_ns)


def write_results(file, result):
    """As `evaluate --json` does."""
    curves = curves_of(result.truth, result.estimates)
    told = {**result.as_dict(), 'grade': 'good', 'sentence': 'right', 'curves': curves}
    file.write_text(json.dumps(told))


def test_two_results_are_linked_in_the_same_plots(browser, evaluated, tmp_path):
    _, result, _ = evaluated
    files = [tmp_path / 'before.json', tmp_path / 'after.json']
    for file in files:
        write_results(file, result)
    assert main(['evaluate', *map(str, files), '--report', str(tmp_path / 'report')]) == 0
    open_page(browser, tmp_path / 'report', 1280, 'dark')
    seconds = click(browser, 1, 'after.json: SFA, one image each')
    wait_for(browser, lambda _: -1 not in browser.execute_script(MARKED))
    marked = np.array(browser.execute_script(MARKED))
    assert len(marked) == 5 + 8 and np.abs(marked - seconds).max() < 0.2


def test_a_page_is_small_and_a_fleet_shares_one_script(evaluated, tmp_path):
    folder, result, _ = evaluated
    assert (folder / PAGE).stat().st_size < LARGEST and (folder / SCRIPT).is_file()
    shared = tmp_path / 'fleet'
    inside = shared / 'garden' / 'evaluation'
    inside.mkdir(parents=True)
    shutil.copy(folder / SCRIPT, shared)
    files = [tmp_path / 'one.json'] * 2
    write_results(files[0], result)
    assert main(['evaluate', *map(str, files), '--report', str(inside)]) == 0
    assert f'src="../../{SCRIPT}"' in (inside / PAGE).read_text('utf-8')
    assert not (inside / SCRIPT).exists()
