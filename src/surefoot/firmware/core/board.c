#include "board.h"

#include <math.h>
#include <string.h>

#include "hal.h"
#include "robot.h"

#define MOTORS SUREFOOT_MOTORS
#define SECOND 1000000u
#define SYNC_WINDOW 10u /* seconds over which the fastest frame is searched */
#define WATCHDOG_TIMEOUT 20000u /* us */
#define REASONS ((size_t)SUREFOOT_REASON_WATCHDOG + 1u)

static const char *const mode_names[] = {"DISARMED", "POSITION", "PWM", "FAULT"};

/* Minimum of arrival time here minus sending time there, of the frames that arrived in one second. */
typedef struct {
    uint64_t second;
    int64_t minimum;
} bucket;

static struct {
    /* The link to the host. */
    surefoot_decoder decoder;
    uint32_t sent;
    uint16_t owner;
    uint32_t last_number, old_numbers;
    uint64_t last_received, clean_since; /* BOARD_NEVER: not clean */
    bucket buckets[SYNC_WINDOW + 1u];
    size_t first_bucket, num_buckets;
    /* Times of the last rejections for each reason, the oldest at `oldest`. Only the lowest 32 bits are stored, so
     * that after 71 minutes a rejection may not be sent. */
    uint32_t rejection_times[REASONS][LIMIT_REFUSALS];
    uint8_t oldest[REASONS], rejections[REASONS];
    /* Modes and commands. */
    uint8_t mode, reason;
    bool fresh, first; /* just armed, and no servo step yet; no command yet */
    uint32_t period, report_after, state_period;
    uint64_t next_state, command_time;
    uint32_t command, stale;
    uint16_t dropped;
    uint32_t dropped_in_a_row;
    float motor_values[MOTORS];
    /* Sensor readings of the last servo step. */
    bool ticked, finite;
    float angle[MOTORS], roll, pitch, voltage, temperature;
    uint64_t low_since, energy; /* energy in uJ: a float would stop increasing */
} board;

/* Text of the next fault: a single buffer, since copies would take stack memory. */

static struct {
    char chars[sizeof(((surefoot_fault *)0)->text)];
    size_t length;
} text;

static void append_text(const char *more)
{
    while (*more != '\0' && text.length < sizeof(text.chars)) {
        text.chars[text.length++] = *more++;
    }
}

/* Start a new text. */
static void set_text(const char *chars)
{
    text.length = 0;
    append_text(chars);
}

static void append_integer(uint32_t number)
{
    char digits[11];
    size_t at = sizeof(digits) - 1u;

    digits[at] = '\0';
    do {
        digits[--at] = (char)('0' + number % 10u);
        number /= 10u;
    } while (number != 0u);
    append_text(digits + at);
}

/* Append a number with a fixed number of decimals. */
static void append_number(float number, int decimals)
{
    const float magnitude = fabsf(number);
    uint32_t unit = 1, whole;
    int k;

    if (isnan(number)) {
        append_text("nan");
        return;
    }
    if (number < 0.0f) {
        append_text("-");
    }
    if (!(magnitude < 1e6f)) {
        append_text(isinf(number) ? "inf" : "1e6 or more");
        return;
    }
    for (k = 0; k < decimals; k++) {
        unit *= 10u;
    }
    whole = (uint32_t)lroundf(magnitude * (float)unit);
    append_integer(whole / unit);
    if (decimals > 0) {
        append_text(".");
        for (k = 0; k < decimals; k++) {
            unit /= 10u;
            append_integer(whole / unit % 10u);
        }
    }
}

/* Append a limit, without trailing zeros. */
static void append_limit(float number)
{
    append_number(number, 3);
    while (text.length > 0u && text.chars[text.length - 1u] == '0') {
        text.length--;
    }
    if (text.length > 0u && text.chars[text.length - 1u] == '.') {
        text.length--;
    }
}

static void append_seconds(uint32_t microseconds)
{
    append_limit((float)microseconds / 1e6f);
}

/* Messages to the host. */

static void send(uint8_t type, const void *message)
{
    static uint8_t frame[SUREFOOT_FRAME_BYTES];

    if (board.sent < UINT32_MAX) {
        const size_t size = surefoot_encode(type, message, ++board.sent, hal_time(), frame);

        (void)hal_write_line(frame, size); /* a frame that does not fit is lost; a newer state follows */
    }
}

/* Send a fault with the current text. */
static void send_fault(uint16_t session, uint8_t reason)
{
    surefoot_fault fault = {.session = session, .reason = reason};

    memcpy(fault.text, text.chars, text.length);
    send(SUREFOOT_FAULT, &fault);
}

/* Reject a message with the current text, at most LIMIT_REFUSALS times per second for each reason. */
static void reject(uint64_t now, uint16_t session, uint8_t reason)
{
    const size_t at = reason < REASONS ? reason : 0u;
    uint32_t *const times = board.rejection_times[at];
    const uint8_t oldest = board.oldest[at];

    if (board.rejections[at] == LIMIT_REFUSALS) {
        if ((uint32_t)now - times[oldest] < SECOND) {
            return;
        }
        times[oldest] = (uint32_t)now;
        board.oldest[at] = (uint8_t)((oldest + 1u) % LIMIT_REFUSALS);
    } else {
        times[board.rejections[at]++] = (uint32_t)now;
    }
    send_fault(session, reason);
}

/* The link. */

static bool link_is_silent(uint64_t now)
{
    return board.clean_since == BOARD_NEVER || now - board.last_received > LIMIT_CLEAN_GAP;
}

static void note_frame(uint64_t now)
{
    if (link_is_silent(now)) {
        board.clean_since = now;
    }
    board.last_received = now;
}

static uint64_t clean_for(uint64_t now)
{
    return link_is_silent(now) ? 0u : now - board.clean_since;
}

static bool is_next(uint32_t number)
{
    if (number <= board.last_number) {
        board.old_numbers++;
        return false;
    }
    board.last_number = number;
    return true;
}

/* Age of a frame sent at time `sent` on the operator's clock: its delay relative to the fastest frame. */
static int64_t age_of(uint64_t now, uint64_t sent)
{
    const uint64_t second = now / SECOND;
    /* Times are clipped to 2^62 us, so that differences do not overflow. */
    const int64_t difference = (int64_t)now - (int64_t)(sent < (1ull << 62) ? sent : (1ull << 62));
    int64_t minimum = difference;
    bucket *newest;
    size_t k;

    while (board.num_buckets > 0u && board.buckets[board.first_bucket].second + SYNC_WINDOW < second) {
        board.first_bucket = (board.first_bucket + 1u) % (SYNC_WINDOW + 1u);
        board.num_buckets--;
    }
    newest = &board.buckets[(board.first_bucket + board.num_buckets + SYNC_WINDOW) % (SYNC_WINDOW + 1u)];
    if (board.num_buckets == 0u || newest->second != second) {
        newest = &board.buckets[(board.first_bucket + board.num_buckets) % (SYNC_WINDOW + 1u)];
        newest->second = second;
        newest->minimum = difference;
        board.num_buckets++;
    } else if (difference < newest->minimum) {
        newest->minimum = difference;
    }
    for (k = 0; k < board.num_buckets; k++) {
        const int64_t one = board.buckets[(board.first_bucket + k) % (SYNC_WINDOW + 1u)].minimum;

        minimum = one < minimum ? one : minimum;
    }
    return difference - minimum;
}

static bool is_armed(void)
{
    return board.mode == SUREFOOT_MODE_POSITION || board.mode == SUREFOOT_MODE_PWM;
}

static uint64_t reserved_until(void)
{
    if (board.owner == 0u) {
        return 0u;
    }
    return is_armed() ? BOARD_NEVER : board.last_received + LIMIT_OWNER_TIMEOUT;
}

/* Modes. */

static uint64_t sooner(uint64_t one, uint64_t other)
{
    return one < other ? one : other;
}

/* Damp the motors, with the current text. */
static void fail(uint64_t now, uint8_t reason)
{
    if (board.mode == SUREFOOT_MODE_FAULT) {
        return; /* keep the first reason */
    }
    board.mode = SUREFOOT_MODE_FAULT;
    board.reason = reason;
    send_fault(board.owner, reason);
    if (board.owner != 0u) {
        board.next_state = sooner(board.next_state, now);
    }
}

static void disarm(uint64_t now)
{
    board.mode = SUREFOOT_MODE_DISARMED;
    if (board.owner != 0u) {
        board.next_state = sooner(board.next_state, now + board.state_period);
    }
}

/* Maximum of two numbers; NaN if one of them is NaN. */
static float greater(float one, float other)
{
    return isnan(one) || one > other ? one : other;
}

/* Reason why the motors must not move, from the sensors of the last servo step, with its text; 0 if they may. */
static uint8_t hazard(uint64_t now)
{
    const float tilt = greater(fabsf(board.roll), fabsf(board.pitch));
    const char *seen = "";
    uint8_t reason;

    if (!board.ticked) {
        return SUREFOOT_REASON_NONE;
    }
    reason = hal_hazard(&seen);
    if (reason != SUREFOOT_REASON_NONE) {
        set_text(seen);
        return reason;
    }
    if (!board.finite) {
        set_text("the angle or speed of a motor is not finite");
        return SUREFOOT_REASON_NOT_FINITE;
    }
    if (!(tilt <= robot_handshake.tilt_limit)) {
        set_text("tilt is ");
        append_number(tilt, 2);
        append_text(" rad; the limit is ");
        append_limit(robot_handshake.tilt_limit);
        return SUREFOOT_REASON_TILT;
    }
    if (board.low_since != BOARD_NEVER && now - board.low_since >= LIMIT_VOLTAGE_TIME) {
        set_text("battery voltage is ");
        append_number(board.voltage, 2);
        append_text(" V; the limit is ");
        append_limit(robot_handshake.voltage_min);
        return SUREFOOT_REASON_BATTERY;
    }
    if (!(board.temperature <= robot_handshake.temperature_max)) {
        set_text("a motor is at ");
        append_number(board.temperature, 0);
        append_text(" degC; the limit is ");
        append_limit(robot_handshake.temperature_max);
        return SUREFOOT_REASON_TEMPERATURE;
    }
    return SUREFOOT_REASON_NONE;
}

/* Messages. */

static void answer_hello(uint64_t now, const surefoot_hello *hello)
{
    surefoot_handshake handshake = robot_handshake;
    uint32_t period = hello->state_period;

    period = period < LIMIT_STATE_PERIOD_MIN ? LIMIT_STATE_PERIOD_MIN : period;
    board.state_period = period > LIMIT_STATE_PERIOD_MAX ? LIMIT_STATE_PERIOD_MAX : period;
    handshake.session = board.owner;
    send(SUREFOOT_HANDSHAKE, &handshake);
    board.next_state = sooner(board.next_state, now + board.state_period);
}

static void start_session(uint64_t now, const surefoot_header *header, const surefoot_hello *hello)
{
    if (board.owner != 0u && now <= reserved_until()) {
        set_text("another operator uses the robot");
        reject(now, hello->session, SUREFOOT_REASON_BUSY);
        return;
    }
    disarm(now);
    board.owner = hello->session;
    board.last_number = header->sequence;
    board.clean_since = BOARD_NEVER;
    board.num_buckets = 0;
    note_frame(now);
    (void)age_of(now, header->time);
    board.command = 0;
    board.command_time = 0;
    board.dropped = 0;
    board.energy = 0;
    answer_hello(now, hello);
}

static void arm(uint64_t now, const surefoot_arm *message)
{
    const uint8_t mode = message->mode;
    const bool possible = mode == SUREFOOT_MODE_POSITION || (mode == SUREFOOT_MODE_PWM && LIMIT_DUTY > 0.0f);
    uint8_t reason;

    if (!possible || (is_armed() && mode != board.mode)) {
        set_text("mode ");
        append_integer(mode);
        append_text(" can't be armed while ");
        append_text(mode_names[board.mode]);
        reject(now, board.owner, SUREFOOT_REASON_MODE);
        return;
    }
    if (message->command_period < robot_handshake.command_period_min
        || message->command_period > robot_handshake.command_period_max
        || message->report_after > message->command_period) {
        set_text("command period is ");
        append_number((float)message->command_period / 1e6f, 3);
        append_text(" s; it must be ");
        append_seconds(robot_handshake.command_period_min);
        append_text(" to ");
        append_seconds(robot_handshake.command_period_max);
        reject(now, board.owner, SUREFOOT_REASON_COMMAND);
        return;
    }
    if (!is_armed() && board.reason != SUREFOOT_REASON_NONE && clean_for(now) < robot_handshake.rearm_after) {
        set_text("the link must be clean for ");
        append_seconds(robot_handshake.rearm_after);
        append_text(" s (");
        append_text(reason_names[board.reason]);
        append_text(")");
        reject(now, board.owner, SUREFOOT_REASON_NOT_CLEAN);
        return;
    }
    reason = hazard(now);
    if (reason != SUREFOOT_REASON_NONE) {
        reject(now, board.owner, reason);
        return;
    }
    board.period = message->command_period;
    board.report_after = message->report_after;
    if (!is_armed()) {
        board.mode = mode;
        board.reason = SUREFOOT_REASON_NONE;
        board.command_time = now;
        board.dropped_in_a_row = 0;
        board.fresh = board.first = true;
    }
    board.next_state = now + board.report_after;
}

/* Drop a command, with the current text. */
static void drop(uint64_t now)
{
    board.dropped++;
    board.dropped_in_a_row++;
    if (is_armed() && board.dropped_in_a_row >= LIMIT_STALE_DROPS) {
        fail(now, SUREFOOT_REASON_STALE);
    }
}

static void take_command(uint64_t now, const surefoot_header *header, uint8_t mode, const float *values, int64_t age)
{
    size_t m;

    if (board.mode != mode) {
        board.dropped++;
        if (board.mode != SUREFOOT_MODE_FAULT) { /* every state of a faulted robot has the reason */
            set_text("a command arrived while ");
            append_text(mode_names[board.mode]);
            reject(now, board.owner, SUREFOOT_REASON_MODE);
        }
        return;
    }
    if (age > (int64_t)(LIMIT_STALE_AFTER * (float)board.period)) {
        board.stale++;
        set_text("commands were late, the last by ");
        append_number((float)age / 1e6f, 3);
        append_text(" s");
        drop(now);
        return;
    }
    for (m = 0; m < MOTORS; m++) {
        const bool position = mode == SUREFOOT_MODE_POSITION;
        const float low = position ? robot_handshake.angle_low[m] : -LIMIT_DUTY;
        const float high = position ? robot_handshake.angle_high[m] : LIMIT_DUTY;

        if (!(values[m] >= low && values[m] <= high)) {
            char name[sizeof(robot_handshake.motor_names[0]) + 1u] = {0};

            memcpy(name, robot_handshake.motor_names[m], sizeof(robot_handshake.motor_names[0]));
            board.dropped++;
            set_text(name);
            append_text(" was commanded to ");
            append_number(values[m], 3);
            fail(now, SUREFOOT_REASON_COMMAND);
            return;
        }
    }
    if (board.first && mode == SUREFOOT_MODE_POSITION && board.ticked) {
        float torque = 0.0f;

        for (m = 0; m < MOTORS; m++) {
            torque = greater(torque, robot_handshake.servo_kp[m] * fabsf(values[m] - board.angle[m]));
        }
        if (!(torque <= LIMIT_FIRST_TORQUE)) {
            set_text("the first command would give ");
            append_number(torque, 1);
            append_text(" N m at once; at most ");
            append_limit(LIMIT_FIRST_TORQUE);
            fail(now, SUREFOOT_REASON_COMMAND);
            return;
        }
    }
    board.first = board.fresh = false;
    board.command = header->sequence;
    board.command_time = now;
    board.dropped_in_a_row = 0;
    memcpy(board.motor_values, values, sizeof(board.motor_values));
    board.next_state = now + board.report_after;
}

static void take_session_frame(uint64_t now, const surefoot_header *header, const uint8_t *payload)
{
    const uint8_t type = header->type;
    const bool command = type == SUREFOOT_POSITION || type == SUREFOOT_PWM;
    const int64_t age = age_of(now, header->time);
    float values[MOTORS];
    surefoot_hello hello;
    surefoot_arm request;

    if (!is_next(header->sequence)) {
        if (command) {
            set_text("commands were repeated or out of order");
            drop(now);
        }
        return;
    }
    note_frame(now);
    switch (type) {
    case SUREFOOT_POSITION:
    case SUREFOOT_PWM:
        /* Both have the session, then one float for each motor. */
        memcpy(values, payload + sizeof(uint16_t), sizeof(values));
        take_command(now, header, type == SUREFOOT_POSITION ? SUREFOOT_MODE_POSITION : SUREFOOT_MODE_PWM, values, age);
        break;
    case SUREFOOT_HELLO:
        memcpy(&hello, payload, sizeof(hello));
        answer_hello(now, &hello);
        break;
    case SUREFOOT_ARM:
        memcpy(&request, payload, sizeof(request));
        arm(now, &request);
        break;
    case SUREFOOT_DAMP:
        set_text("the operator requested it");
        fail(now, SUREFOOT_REASON_HOST);
        break;
    case SUREFOOT_DISARM:
        if (is_armed()) {
            disarm(now);
        }
        break;
    case SUREFOOT_BYE:
        disarm(now);
        board.owner = 0;
        board.next_state = BOARD_NEVER;
        break;
    default: /* a message from a robot */
        break;
    }
}

static void take_frame(uint64_t now)
{
    const surefoot_header header = board.decoder.header;
    const uint8_t *payload = surefoot_payload(&board.decoder);
    uint16_t session = 0;

    if (header.type == SUREFOOT_PING) {
        /* A ping has no session and changes nothing, so it is answered whatever its number. */
        surefoot_pong pong;

        if (board.owner != 0u) {
            note_frame(now);
        }
        memcpy(&pong, payload, sizeof(pong));
        send(SUREFOOT_PONG, &pong);
        return;
    }
    if (header.type != SUREFOOT_PONG) { /* all other messages start with the session */
        memcpy(&session, payload, sizeof(session));
    }
    if (header.type == SUREFOOT_HELLO && session != 0u && session != board.owner) {
        surefoot_hello hello;

        memcpy(&hello, payload, sizeof(hello));
        start_session(now, &header, &hello);
    } else if (session == 0u || session != board.owner) {
        set_text("session ");
        append_integer(session);
        append_text(" is unknown");
        reject(now, session, SUREFOOT_REASON_SESSION);
    } else {
        take_session_frame(now, &header, payload);
    }
}

/* Functions that the hardware calls. */

void board_start(void)
{
    memset(&board, 0, sizeof(board));
    board.clean_since = board.next_state = board.low_since = BOARD_NEVER;
    board.state_period = LIMIT_STATE_PERIOD_MAX;
    hal_start();
    hal_enable_motors();
    hal_start_watchdog(WATCHDOG_TIMEOUT);
}

void board_receive(const uint8_t *bytes, size_t size)
{
    const uint64_t now = hal_time();
    size_t k;

    for (k = 0; k < size; k++) {
        switch (surefoot_decode(&board.decoder, bytes[k])) {
        case SUREFOOT_FRAME:
            take_frame(now);
            break;
        case SUREFOOT_FOREIGN:
            board.clean_since = BOARD_NEVER;
            set_text("schema is " ROBOT_SCHEMA_TEXT);
            reject(now, 0, SUREFOOT_REASON_SCHEMA);
            break;
        case SUREFOOT_DAMAGED:
        case SUREFOOT_UNKNOWN:
            board.clean_since = BOARD_NEVER;
            break;
        case SUREFOOT_NOTHING:
            break;
        }
    }
}

static void check(uint64_t now)
{
    const char *seen = "";
    uint8_t reason;

    if (now - board.command_time >= robot_handshake.command_timeout) {
        set_text("no command for ");
        append_seconds(robot_handshake.command_timeout);
        append_text(" s");
        fail(now, SUREFOOT_REASON_TIMEOUT);
        return;
    }
    reason = hazard(now);
    if (reason != SUREFOOT_REASON_NONE) {
        fail(now, reason);
        return;
    }
    reason = hal_sit(&seen);
    if (reason != SUREFOOT_REASON_NONE && board.reason == SUREFOOT_REASON_NONE) {
        board.reason = reason;
        set_text(seen);
        send_fault(board.owner, reason);
    }
}

void board_tick(void)
{
    const uint64_t now = hal_time();
    float speed[MOTORS], torque[MOTORS], temperature[MOTORS], attitude[3], rates[3], power = 0.0f;
    motor_command command[MOTORS];
    size_t m;

    hal_read_motors(board.angle, speed, torque);
    hal_read_imu(attitude, rates);
    hal_read_temperatures(temperature);
    board.roll = attitude[0];
    board.pitch = attitude[1];
    board.voltage = hal_read_voltage();
    board.temperature = temperature[0];
    board.finite = true;
    for (m = 0; m < MOTORS; m++) {
        board.temperature = greater(board.temperature, temperature[m]);
        board.finite = board.finite && isfinite(board.angle[m]) && isfinite(speed[m]);
        power += torque[m] * speed[m];
    }
    if (fabsf(power) < 1e9f) {
        board.energy += (uint64_t)(fabsf(power) * (float)robot_handshake.servo_period);
    }
    board.ticked = true;
    if (board.voltage >= robot_handshake.voltage_min) {
        board.low_since = BOARD_NEVER;
    } else {
        board.low_since = sooner(board.low_since, now);
    }
    if (is_armed()) {
        check(now);
    }
    if (is_armed() && board.fresh) {
        /* Before the first command, servos hold the present angles, and motors get zero duty. */
        board.fresh = false;
        for (m = 0; m < MOTORS; m++) {
            board.motor_values[m] = board.mode == SUREFOOT_MODE_POSITION ? board.angle[m] : 0.0f;
        }
    }
    for (m = 0; m < MOTORS; m++) {
        const float limit = robot_effort_limit[m];
        const bool position = board.mode == SUREFOOT_MODE_POSITION, pwm = board.mode == SUREFOOT_MODE_PWM;
        float effort;

        /* Damped motors have the servo's own derivative gain. */
        command[m].target = position ? board.motor_values[m] : 0.0f;
        command[m].kp = position ? robot_handshake.servo_kp[m] : 0.0f;
        command[m].kd = pwm ? 0.0f : robot_handshake.servo_kd[m];
        command[m].feedforward = pwm ? board.motor_values[m] * limit : 0.0f;
        effort = command[m].feedforward + command[m].kp * (command[m].target - board.angle[m])
                 - command[m].kd * speed[m];
        /* An effort that is NaN becomes zero. */
        command[m].effort = effort > limit ? limit : effort < -limit ? -limit : isnan(effort) ? 0.0f : effort;
    }
    hal_drive_motors(command);
    hal_feed_watchdog();
}

/* Return the nearest integer, clipped; the minimum for NaN. */
static int32_t rounded(float number, float low, float high)
{
    return (int32_t)(!(number > low) ? low : number > high ? high : roundf(number));
}

void board_report(void)
{
    const uint64_t now = hal_time();
    surefoot_state state = {.session = board.owner, .mode = board.mode, .reason = board.reason};
    float angle[MOTORS], speed[MOTORS], torque[MOTORS], temperature[MOTORS], attitude[3], rates[3];
    const uint64_t age = (now - board.command_time + 5u) / 10u;
    uint64_t following;
    size_t m;

    if (now < board.next_state) {
        return;
    }
    hal_read_motors(angle, speed, torque);
    hal_read_imu(attitude, rates);
    hal_read_temperatures(temperature);
    state.command = board.command;
    state.command_age = (uint16_t)(board.command != 0u && age < UINT16_MAX ? age : UINT16_MAX);
    state.dropped = board.dropped;
    memcpy(state.motor_angle, angle, sizeof(angle));
    memcpy(state.motor_velocity, speed, sizeof(speed));
    memcpy(state.roll_pitch_yaw, attitude, sizeof(attitude));
    memcpy(state.angular_velocity_base, rates, sizeof(rates));
    for (m = 0; m < MOTORS; m++) {
        state.motor_torque[m] = (int16_t)rounded(torque[m] / 0.005f, INT16_MIN, INT16_MAX);
        state.temperature[m] = (uint8_t)rounded(temperature[m], 0, UINT8_MAX);
    }
    state.energy = (float)board.energy / 1e6f;
    state.voltage = (uint16_t)rounded(hal_read_voltage() * 1000.0f, 0, UINT16_MAX);
    send(SUREFOOT_STATE, &state);
    following = board.next_state + (is_armed() ? board.period : board.state_period);
    board.next_state = following > now ? following : now + 1000u;
}

board_status board_show(void)
{
    board_status status = {
        .robot = robot_handshake.robot,
        .mode = board.mode,
        .reason = board.reason,
        .owner = board.owner,
        .command_time = board.command_time,
        .next_state = board.next_state,
        .reserved_until = reserved_until(),
        .frames = board.decoder.frames,
        .damaged = board.decoder.damaged,
        .foreign = board.decoder.foreign,
        .unknown = board.decoder.unknown,
        .old_numbers = board.old_numbers,
        .stale = board.stale,
    };

    memcpy(status.motor_values, board.motor_values, sizeof(status.motor_values));
    return status;
}

void board_run(void)
{
    uint8_t bytes[64]; /* few enough not to delay the servo */
    uint64_t due;

    board_start();
    due = hal_time();
    for (;;) {
        uint64_t now;

        board_receive(bytes, hal_read_line(bytes, sizeof(bytes)));
        board_report();
        now = hal_time();
        if (now >= due) {
            board_tick();
            /* A late step is not made up for. */
            due = (now - due < robot_handshake.servo_period ? due : now) + robot_handshake.servo_period;
        }
        hal_idle();
    }
}
